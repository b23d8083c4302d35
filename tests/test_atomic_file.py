"""Files that appear as a whole: permissions, links, devices and open files."""

import json
import os
import stat
import threading

import pytest
from replay_files import OUTPUTS, falling_through_quads, left_behind, replay
from usd_stages import save

from warp_bsc import _atomic_file
from warp_bsc.cli.main import main


@pytest.fixture
def stage(tmp_path):
    return falling_through_quads(tmp_path)


@pytest.fixture(params=["without a name", "with a name"])
def temporary(request, monkeypatch):
    """Both kinds of temporary file, as far as the system has the first."""
    if request.param == "with a name":
        monkeypatch.setattr(_atomic_file, "_give_name", lambda *_: (_ for _ in ()).throw(OSError("not here")))


@pytest.fixture
def umask():
    old = os.umask(0o027)
    yield
    os.umask(old)


def permissions(file):
    return file.stat().st_mode & 0o777


def test_permissions_are_those_of_the_file_before_or_as_the_umask_has_it(stage, tmp_path, temporary, umask):
    assert [permissions(file) for file in replay(stage)] == [0o640] * len(OUTPUTS)
    for file in tmp_path.iterdir():
        file.chmod(0o604)
    assert [permissions(file) for file in replay(stage)] == [0o604] * len(OUTPUTS)
    assert left_behind(tmp_path) == []


def test_links_are_followed(stage, tmp_path, temporary):
    (tmp_path / "elsewhere").mkdir()
    targets = [tmp_path / "elsewhere" / name for name in OUTPUTS]
    for target in targets:
        (tmp_path / target.name).symlink_to(target.relative_to(tmp_path))
    targets[0].write_text("old")  # the others are not there yet
    old = targets[0].stat().st_ino
    with targets[0].open() as reader:
        files = replay(stage)
        assert reader.read() == "old"  # it was replaced, not written to
    assert targets[0].stat().st_ino != old
    for file, target in zip(files, targets, strict=True):
        assert file.is_symlink() and target.is_file() and not target.is_symlink()
    assert json.loads(targets[0].read_text())["hits"] == 1
    assert left_behind(tmp_path) == left_behind(tmp_path / "elsewhere") == []


def test_devices_and_pipes_are_written_to(stage, tmp_path):
    null, pipe = tmp_path / "null", tmp_path / "pipe"
    null.symlink_to("/dev/null")
    os.mkfifo(pipe)
    read = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()))
    reader.start()
    files = ["--json", str(null), "--csv", str(pipe)]
    assert main(["replay", save(stage), "--device", "cpu", "--no-intersections", *files]) == 0
    reader.join(10)
    assert null.is_symlink() and stat.S_ISCHR(null.stat().st_mode) and stat.S_ISFIFO(pipe.stat().st_mode)
    assert len(read[0].splitlines()) == 2


def test_open_files_are_written_to(stage, tmp_path):
    log = tmp_path / "log"
    log.write_text("before\n")
    with log.open("a") as file:
        path = f"/dev/fd/{file.fileno()}"
        assert main(["replay", save(stage), "--device", "cpu", "--no-intersections", "--csv", path]) == 0
    lines = log.read_text().splitlines()
    assert lines[0] == "before" and lines[1].startswith("interval,") and len(lines) == 3
