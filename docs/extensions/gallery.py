"""How examples run inside the manual: where they write, which pictures are shown, in which order they stand."""

import shutil
from pathlib import Path
from typing import Any

from sphinx_gallery.scrapers import figure_rst

_OUTPUT = Path(__file__).resolve().parents[1] / "_build" / "examples"
_ORDER = [
    "render_mesh",
    "simulation",
    "fit_volume",
    "fit_photos",
    "own_training_loop",
    "recover_pose",
    "tomography",
    "best_viewpoint",
    "fit_transfer",
]


def output_folder(gallery_conf: dict[str, Any], script_vars: dict[str, Any]) -> list[str]:
    """The argument of an example: an empty folder of its own to write to."""
    folder = _folder_of(script_vars["src_file"])
    shutil.rmtree(folder, ignore_errors=True)
    return [str(folder)]


def scrape_pictures(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Shows the pictures that a block of an example wrote into its folder."""
    names = []
    for picture in sorted(_folder_of(block_vars["src_file"]).glob("*.png")):
        shown = picture.with_suffix(".shown")
        if not shown.exists():
            shown.touch()
            names.append(next(block_vars["image_path_iterator"]))
            shutil.copy(picture, names[-1])
    # One by one: several in a row would be too small to see anything.
    return "\n".join(figure_rst([name], gallery_conf["src_dir"]) for name in names)


class Order:
    """Sorts examples from the first to look at to the last."""

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def __call__(self, name: str) -> int:
        """The place of an example; new ones come last."""
        stem = Path(name).stem
        return _ORDER.index(stem) if stem in _ORDER else len(_ORDER)


def _folder_of(script: str) -> Path:
    return _OUTPUT / Path(script).stem
