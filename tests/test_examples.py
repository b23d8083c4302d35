"""The examples: all start, keep the promise of the stage for some frames, and say how to use them."""

import importlib.util
from pathlib import Path

import pytest
from newton.viewer import ViewerNull

FOLDER = Path(__file__).parents[1] / "examples"
EXAMPLES = sorted(FOLDER.glob("example_*.py"))
BULLET = FOLDER / "example_cloth_bullet.py"
FRAMES = 3

each_example = pytest.mark.parametrize("path", EXAMPLES, ids=[path.stem for path in EXAMPLES])


def load(path):
    """The class ``Example`` of a script."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Example


def run(path, frames, *options):
    """Runs an example for some frames, as its script would."""
    example_class = load(path)
    args = example_class.create_parser().parse_args(["--viewer", "null", "--num-frames", str(frames), *options])
    viewer = ViewerNull(num_frames=frames)
    example = example_class(viewer, args)
    while viewer.is_running():
        example.step()
        example.render()
    return example


def test_there_are_examples():
    assert len(EXAMPLES) >= 3


@each_example
def test_first_frames(path):
    report = run(path, FRAMES).solver.report
    assert report.steps >= FRAMES
    assert report.uncertified_steps == 0


@each_example
def test_help(path, capsys):
    with pytest.raises(SystemExit, match=r"^0$"):
        load(path).create_parser().parse_args(["--help"])
    assert "--no-ccd" in capsys.readouterr().out


def test_bullet_is_stopped(capsys):
    example = run(BULLET, 60, "--speed", "10")
    assert example.solver.report.steps >= 240
    example.test_final()
    example.print_report()
    assert "0 particles of the patch are behind the sheet" in capsys.readouterr().out


def test_bullet_passes_without_stage():
    example = run(BULLET, 10, "--no-ccd")
    with pytest.raises(AssertionError, match="441 particles of the patch passed"):
        example.test_final()
