"""Mistakes on the command line: one sentence each, in the words of the help, and before anything heavy is imported."""

import pytest
from commands.helpers import fails

import difftetvr.cli as cli

FIT = ["fit", "tooth", "-o", "x"]

MISTAKES = [
    (["fit"], "'difftetvr fit' needs CAPTURE and --output OUT; see 'difftetvr fit --help'."),
    (["fit", "tooth"], "'difftetvr fit' needs --output OUT;"),
    ([*FIT, "extra"], "'extra' is one argument too many;"),
    ([*FIT, "--celsl", "3"], "There is no option '--celsl' (is it '--cells'?);"),
    ([*FIT, "-z"], "There is no option '-z';"),
    ([*FIT, "--cells"], "--cells has no value; give a whole number."),
    ([*FIT, "--cells="], "--cells is ''; give a whole number."),
    ([*FIT, "--cells", "1.5"], "--cells is '1.5'; give a whole number."),
    ([*FIT, "--motion.every", "x"], "--motion.every is 'x'; give a whole number."),
    ([*FIT, "--betas", "0.5", "x"], "--betas is '0.5 x'; give 2 numbers."),
    ([*FIT, "--grid", "1", "2"], "--grid is '1 2'; give 3 whole numbers."),
    ([*FIT, "--loss", "l3"], "--loss is 'l3'; give one of l2, l1, l1-ssim."),
    ([*FIT, "--background", "grey"], "--background is 'grey'; give black, white, random or 3 numbers."),
    ([*FIT, "--no-move=1"], "--move takes no value; leave out '1'."),
    ([*FIT, "--initial_mesh", ""], "--initial-mesh is ''; give a name or a path."),
    (["fit", "tooth", "-o", ""], "--output is ''; give a path."),
    (["fit", "", "-o", "x"], "CAPTURE is ''; give a name or a path."),
    (["render", "a.vtu", "-o", "a.png", "--eye", "1", "2"], "--eye is '1 2'; give 3 numbers."),
    (["compare", "tooth", "", "-o", "x.png"], "MODEL is ''; give one or more, each a path."),
    (["info", "a.vtu", "--step", "last"], "--step is 'last'; give a whole number."),
    ([*FIT, "--device", "\x1b[31m", "--cells", "\x1b[31m"], r"--cells is '\x1b[31m'; give a whole number."),
]


@pytest.mark.parametrize(("args", "sentence"), MISTAKES, ids=lambda value: " ".join(value)[:40] if value else "")
def test_mistakes_are_one_sentence(capsys, args, sentence):
    assert fails(capsys, *args).startswith(f"difftetvr: {sentence}")


def test_what_is_valid_is_never_taken_for_a_mistake(capsys):
    command = cli.parse_command(
        ["fit", "--cells=7", "--initial_mesh", "a.vtu", "-o", ".", "tooth", "--harmonics", "None"]
    )
    assert (command.config.cells, command.config.initial_mesh, command.config.harmonics) == (7, "a.vtu", None)
    assert str(command.output) == "."
    assert capsys.readouterr() == ("", "")
