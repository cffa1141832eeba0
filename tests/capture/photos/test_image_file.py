"""Images and masks in files: every kind, shrunk while they are decoded, damaged, hostile."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from capture.damage import damaged_copies
from capture.photos.photo_checks import check_sentence
from capture.photos.photo_scene import on_grey, orbit, picture
from PIL import Image

from difftetvr import trusting
from difftetvr.capture.photos import image_file
from difftetvr.capture.photos.image_file import image_header, read_image, read_mask
from difftetvr.errors import CaptureError


def write_png(path: Path, values: np.ndarray) -> None:
    """Of 16 bits a channel, which Pillow does not write."""
    height, width, channels = values.shape
    rows = values.astype(">u2").reshape(height, -1)
    data = b"".join(b"\0" + row.tobytes() for row in rows)
    write_chunks(path, (width, height, 16, {1: 0, 2: 4, 3: 2, 4: 6}[channels]), zlib.compress(data))


def write_chunks(path: Path, header: tuple[int, int, int, int], data: bytes) -> None:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    start = chunk(b"IHDR", struct.pack(">IIBBBBB", *header, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + start + chunk(b"IDAT", data) + chunk(b"IEND", b""))


def test_jpegs_are_decoded_small(tmp_path: Path) -> None:
    y, x = np.mgrid[:203, :301]
    values = np.stack([127 + 100 * np.sin(x / 9), 127 + 100 * np.cos(y / 7), x * 0.8], axis=-1).astype(np.uint8)
    Image.fromarray(values).save(tmp_path / "a.jpg", quality=95)
    whole = read_image(tmp_path / "a.jpg")
    for factor in (2, 3, 4, 6, 8, 12, 16):
        height, width = 203 // factor, 301 // factor
        means = whole[: height * factor, : width * factor].reshape(height, factor, width, factor, 3).mean(dim=(1, 3))
        small = read_image(tmp_path / "a.jpg", factor)
        assert small.shape == means.shape
        assert float((small - means).abs().mean()) < 0.01


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("factor", [1, 3, 7])
def test_bands_give_what_the_whole_gives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, channels: int, factor: int
) -> None:
    values = np.random.default_rng(0).integers(0, 256, (61, 83, channels), dtype=np.uint8)
    Image.fromarray(values.squeeze()).save(tmp_path / "a.png")
    whole = read_image(tmp_path / "a.png", factor)
    mask = read_mask(tmp_path / "a.png", (83 // factor, 61 // factor), factor)
    monkeypatch.setattr(image_file, "_BAND_PIXELS", 83 * 7 * 2)
    assert torch.equal(read_image(tmp_path / "a.png", factor), whole)
    assert torch.equal(read_mask(tmp_path / "a.png", (83 // factor, 61 // factor), factor), mask)


def test_kinds_of_images(tmp_path: Path) -> None:
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20
    expected = torch.from_numpy(grey / np.float32(255))[..., None].expand(3, 4, 3)
    for name in ("grey.png", "grey.bmp", "grey.tif"):
        Image.fromarray(grey).save(tmp_path / name)
        assert torch.equal(read_image(tmp_path / name), expected)
    Image.fromarray(grey).convert("RGB").save(tmp_path / "grey.webp", lossless=True)
    assert torch.equal(read_image(tmp_path / "grey.webp"), expected)
    Image.fromarray(np.stack([grey, grey], axis=-1)).save(tmp_path / "grey_alpha.png")
    assert read_image(tmp_path / "grey_alpha.png").shape == (3, 4, 4)
    Image.fromarray(grey).convert("P").save(tmp_path / "palette.png", transparency=0)
    assert read_image(tmp_path / "palette.png").shape == (3, 4, 4)
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(CaptureError, match="no image that can be read"):
        read_image(tmp_path / "text.png")
    with pytest.raises(CaptureError, match="too few to shrink by 5"):
        read_image(tmp_path / "grey.png", 5)
    Image.fromarray(grey.astype(np.float32)).save(tmp_path / "float.tif")
    with pytest.raises(CaptureError, match="neither 8 nor plain 16 bits"):
        read_image(tmp_path / "float.tif")


@pytest.mark.parametrize(
    ("dtype", "words"),
    [("float32", "floats of 32 bits"), ("float16", "floats of 16 bits"), ("uint32", "integers of 32 bits")],
)
def test_depths_that_are_not_read_are_no_damage(tmp_path: Path, dtype: str, words: str) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((4, 5, 3), dtype), photometric="rgb")
    for read in (image_header, read_image, lambda path: read_mask(path, (5, 4))):
        with pytest.raises(
            CaptureError, match=f"holds {words}, neither 8 nor plain 16 bits a channel; save it"
        ) as error:
            read(tmp_path / "a.tif")
        check_sentence(error.value)
    # A JPEG of 12 bits.
    Image.fromarray(np.zeros((4, 5, 3), np.uint8)).save(tmp_path / "a.jpg")
    (tmp_path / "a.jpg").write_bytes(
        (tmp_path / "a.jpg").read_bytes().replace(b"\xff\xc0\0\x11\x08", b"\xff\xc0\0\x11\x0c")
    )
    with pytest.raises(CaptureError, match=r"holds what cannot be read \(cannot handle 12-bit layers\), neither 8"):
        read_image(tmp_path / "a.jpg")


def test_kinds_that_cameras_and_programs_write(tmp_path: Path) -> None:
    """Of several pictures the first; colours of print and palettes with alpha become what they look like."""
    color = np.full((6, 8, 3), (200, 100, 50), np.uint8)
    image, other = Image.fromarray(color), Image.fromarray(255 - color)
    several = {"save_all": True, "append_images": [other]}
    turned = Image.Exif()
    turned[274] = 6  # by a quarter, which is ignored, as the size shows
    writes = {
        "print.jpg": (image.convert("CMYK"), {"quality": 100}),
        "fine.jpg": (image, {"quality": 100, "progressive": True}),
        "phone.jpg": (image, {"quality": 100, "format": "MPO", **several}),
        "turned.jpg": (image, {"quality": 100, "exif": turned}),
        "moving.png": (image, several),
        "moving.webp": (image, {"lossless": True, **several}),
    }
    for name, (picture_of, options) in writes.items():
        picture_of.save(tmp_path / name, **options)
        values = read_image(tmp_path / name)
        assert values.shape == (6, 8, 3) and np.abs(values.numpy() - color / 255).max() < 0.01, name
    clear = Image.fromarray(np.arange(48, dtype=np.uint8).reshape(6, 8) % 2, mode="P")
    clear.putpalette([255, 0, 0, 0, 255, 0])
    clear.save(tmp_path / "clear.png", transparency=bytes([0, 128]))
    values = read_image(tmp_path / "clear.png").numpy()
    assert np.array_equal(values[0, 0], (0, 0, 0, 0)) and np.allclose(values[0, 1], (0, 128 / 255, 0, 128 / 255))
    Image.fromarray(color[..., 0] > 100).save(tmp_path / "bits.png")
    assert float(read_image(tmp_path / "bits.png").min()) == 1.0


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_16_bits_of_grey_are_averaged_before_they_are_rounded(tmp_path: Path, suffix: str) -> None:
    grey = np.array([[0, 257 * 9 + 40], [65535, 300]], dtype=np.uint16)
    Image.fromarray(grey).save(tmp_path / f"deep{suffix}")
    assert image_header(tmp_path / f"deep{suffix}").has_16_bits
    image = read_image(tmp_path / f"deep{suffix}")
    np.testing.assert_allclose(image, np.repeat(grey[..., None] / 65535, 3, axis=2), atol=1e-7)
    mean = read_image(tmp_path / f"deep{suffix}", 2)
    assert float(mean[0, 0, 1]) == pytest.approx(grey.mean() / 65535, rel=1e-6)


@pytest.mark.parametrize("channels", [3, 4])
def test_16_bits_of_colours(tmp_path: Path, channels: int) -> None:
    values = np.random.default_rng(1).integers(0, 65536, (5, 6, channels)).astype(np.uint16)
    values[..., 3:] = 65535
    write_png(tmp_path / "deep.png", values)
    assert image_header(tmp_path / "deep.png").has_16_bits
    assert np.abs(read_image(tmp_path / "deep.png").numpy() - values / 65535).max() <= 1 / 255


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_damaged_images(tmp_path: Path, suffix: str) -> None:
    path, failures = tmp_path / f"a{suffix}", 0
    Image.fromarray(on_grey(picture(orbit()[0]))).save(path)
    for data in damaged_copies(path.read_bytes(), seed=5, count=90):
        path.write_bytes(data)
        try:
            read_image(path)
        except CaptureError as error:
            failures += 1
            check_sentence(error)
    assert failures >= 20


def test_only_formats_of_photographs_are_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow has PostScript drawn by another program, which it would find here."""
    (tmp_path / "gs").write_text(f'#!/bin/sh\n[ "$1" = --version ] && {{ echo 10.0; exit; }}\ntouch {tmp_path}/ran\n')
    (tmp_path / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    box = "%%BoundingBox: 0 0 16 16\n%%EndComments\nshowpage\n%%EOF\n"
    (tmp_path / "a.png").write_text(f"%!PS-Adobe-3.0 EPSF-3.0\n{box}")
    Image.fromarray(np.zeros((4, 4), dtype=np.uint8)).save(tmp_path / "b.png", format="GIF")
    for name in ("a.png", "b.png"):
        for read in (image_header, read_image, lambda path: read_mask(path, (16, 16))):
            with pytest.raises(CaptureError, match="no image that can be read") as error:
                read(tmp_path / name)
            check_sentence(error.value)
    assert not (tmp_path / "ran").exists()


def test_images_that_unpack_to_more_than_allowed(tmp_path: Path) -> None:
    """A limit on what a header announces, found before anything is decoded; larger ones only if they are trusted."""
    empty = zlib.compress(b"")
    write_chunks(tmp_path / "bomb.png", (20_000, 20_000, 8, 2), empty)
    for read in (
        lambda: read_image(tmp_path / "bomb.png", 60),
        lambda: read_mask(tmp_path / "bomb.png", (20_000,) * 2),
    ):
        with pytest.raises(CaptureError, match=r"unpack to more than 1 GiB; .*--allow-large") as error:
            read()
        check_sentence(error.value)
    write_chunks(tmp_path / "large.png", (14_000, 14_000, 8, 2), empty)
    with pytest.raises(CaptureError, match="get the file anew"):
        read_image(tmp_path / "large.png", 60)
    write_chunks(tmp_path / "huge.png", (2**31 - 1, 2**31 - 1, 8, 2), empty)
    with trusting(large=True), pytest.raises(CaptureError, match="of memory can be used") as error:
        read_image(tmp_path / "huge.png", 60)
    check_sentence(error.value)


def test_what_decoding_takes(tmp_path: Path) -> None:
    values = np.zeros((160, 320, 3), dtype=np.uint8)
    sizes = {}
    for name, options in (("a.png", {}), ("a.jpg", {}), ("b.jpg", {"progressive": True}), ("a.webp", {})):
        Image.fromarray(values).save(tmp_path / name, **options)
        header = image_header(tmp_path / name)
        assert header.size == (320, 160)
        sizes[name] = [header.decoding_bytes(shrink) / (320 * 160) for shrink in (1, 4, 12)]
    assert sizes == {"a.png": [4, 4, 4], "a.jpg": [4, 1 / 4, 1 / 4], "b.jpg": [10, 6.25, 6.25], "a.webp": [16, 16, 16]}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes")
def test_pipes_and_folders_are_no_images(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.png")
    with pytest.raises(CaptureError, match="a pipe or a device"):
        read_mask(tmp_path / "a.png", (4, 4))
    with pytest.raises(CaptureError, match="a folder"):
        read_image(tmp_path)


def test_masks_of_every_kind(tmp_path: Path) -> None:
    kept = np.array([[True, False, True], [False, False, True]])
    lit = np.where(kept, 255, 0).astype(np.uint8)
    white, black = np.full_like(lit, 255), np.zeros_like(lit)
    kinds = {
        "grey": lit,
        "labels": np.where(kept, 1, 0).astype(np.uint8),
        "deep": np.where(kept, 3, 0).astype(np.uint16),
        "bits": kept,
        "colours": np.stack([lit, lit, lit], axis=-1),
        "dark blue": np.stack([black, black, lit // 255], axis=-1),
        "opaque": np.stack([lit, lit, lit, white], axis=-1),
        "alpha of white": np.stack([white, white, white, lit], axis=-1),
        "alpha of black": np.stack([black, black, black, lit], axis=-1),
        "alpha of grey": np.stack([white, lit], axis=-1),
        "both": np.stack([lit, lit, lit, lit], axis=-1),
    }
    for name, values in kinds.items():
        Image.fromarray(values).save(tmp_path / "mask.png")
        mask = read_mask(tmp_path / "mask.png", (3, 2))
        assert mask is not None and np.array_equal(mask, kept), name
    Image.fromarray(lit).convert("P").save(tmp_path / "mask.png")
    assert np.array_equal(read_mask(tmp_path / "mask.png", (3, 2)), kept)
    Image.fromarray(black).save(tmp_path / "mask.png")
    assert not read_mask(tmp_path / "mask.png", (3, 2)).any()
    assert read_mask(tmp_path / "mask.png", (2, 3)) is None
