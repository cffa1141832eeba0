"""What the commands say of volumes: without a transfer function, too, and of which values they show."""

import json
import re

import numpy as np
import pytest
from commands.helpers import FEW_ROUNDS, fails

from difftetvr import cli


@pytest.fixture
def scan(tmp_path):
    """A ball of 12-bit values in 16 bits with a transfer function beside it."""
    x = np.linspace(-1, 1, 10)
    ball = np.clip(1 - np.sqrt(x[:, None, None] ** 2 + x[None, :, None] ** 2 + x[None, None, :] ** 2), 0, 1)
    head = "NRRD0004\ntype: uint16\ndimension: 3\nsizes: 10 10 10\nspacings: 1 1 2.5\nendian: little\nencoding: raw\n\n"
    (tmp_path / "ct.nrrd").write_bytes(head.encode() + (100 + ball * 3995).astype("<u2").tobytes())
    function = {"scalar": [0, 0.3, 1], "opacity": [0, 0, 1], "color": [[0, 0, 0], [1, 0.6, 0.3], [1, 1, 1]]}
    (tmp_path / "tf.json").write_text(json.dumps(function))
    return str(tmp_path / "ct.nrrd")


def test_info_describes_a_volume_without_a_transfer_function(scan, capsys):
    assert cli.main(["info", scan]) == 0
    said = re.sub(r"\s+", " ", capsys.readouterr().out)
    for part in ("10 x 10 x 10", "1 x 1 x 2.5", "uint16, 100 to ", "50 % below", "99 % below", "0 to 1"):
        assert part in said
    assert cli.main(["info", scan, "--value-range", "0", "4095"]) == 0
    assert "values 0 to 4095" in re.sub(r"\s+", " ", capsys.readouterr().out)


def test_fit_says_the_range_and_keeps_a_given_one(scan, tmp_path, capsys):
    options = ["--transfer-function", str(tmp_path / "tf.json"), "--width", "12", "--height", "12", "--views", "5"]
    few = ["--cells", "200", "--iterations", "2", *FEW_ROUNDS, "--evaluate-every", "0", "--device", "cpu"]
    assert cli.main(["fit", scan, "-o", str(tmp_path / "out"), *options, *few]) == 0
    assert "stand for 0 to 1 of the transfer function; --value-range says otherwise." in capsys.readouterr().out
    given = ["--value-range", "500", "2000"]
    assert cli.main(["fit", scan, "-o", str(tmp_path / "given"), *options, *given, *few]) == 0
    assert "lie outside of the range 500 to 2000 and are taken for its ends." in capsys.readouterr().out
    saved = json.loads((tmp_path / "given" / "config.json").read_text())
    assert saved["capture_options"]["value_range"] == [500, 2000]
    assert cli.main(["eval", str(tmp_path / "given" / "model.vtu"), scan, *options, *given]) == 0


def test_blank_views_are_an_error_that_names_what_to_change(scan, tmp_path, capsys):
    options = ["--transfer-function", str(tmp_path / "tf.json"), "--width", "8", "--height", "8"]
    message = fails(capsys, "fit", scan, "-o", str(tmp_path / "out"), *options, "--value-range", "0", "65535")
    assert "black" in message and "tf.json" in message and "0 to 65535" in message
    assert not (tmp_path / "out").exists()
