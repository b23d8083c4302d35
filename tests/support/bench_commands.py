"""What the tests of ``warp-bsc bench`` have in common: runs of a command, its JSON, an interrupt, and wrong use."""

import json

from warp_bsc.cli.main import main


def runner(benchmark):
    """Returns a function that runs a benchmark on the CPU, and returns what it has printed."""

    def run(capsys, *arguments, status=0):
        assert main(["bench", benchmark, *map(str, arguments), "--device", "cpu"]) == status
        return capsys.readouterr()

    return run


def check_json_file(output, path, found, title):
    """Checks that a command, with its table below a title, has written to a file what it prints as JSON."""
    written = json.loads(path.read_text())
    assert written.pop("record")["command"] == found.pop("record")["command"]
    assert written == found
    assert output.out.startswith(title)


def check_interrupt(monkeypatch, module, name, measured, run, path, what="runs"):
    """Checks that a command shows, and writes to a path if there is one, the two runs before an interrupt.

    Args:
        monkeypatch: The fixture.
        module, name: The function that measures, which is made up.
        measured: Its calls so far.
        run: Runs the command with more arguments.
        path: Where it writes; None for nowhere.
        what: What is missing then.

    Returns:
        What was printed.
    """
    made_up = getattr(module, name)

    def interrupt_third(*arguments, **options):
        if len(measured) == 2:
            raise KeyboardInterrupt
        return made_up(*arguments, **options)

    monkeypatch.setattr(module, name, interrupt_third)
    output = run(*([] if path is None else ["--json", path]), status=130)
    assert f"Interrupted: the other {what} are missing." in output.out
    assert output.err == "warp-bsc: interrupted\n"
    if path is not None:
        found = json.loads(path.read_text())
        assert (len(found["runs"]), found["partial"]) == (2, True)
    return output.out


def check_wrong_use(output, part):
    """Checks that a command says in one line of errors what is wrong, and prints nothing else."""
    (line,) = output.err.splitlines()
    assert line.startswith("warp-bsc: error: ")
    assert part in line
    assert output.out == ""
    return line


def fail(capsys, *arguments):
    """Returns the error of a benchmark that is used wrongly."""
    assert main(["bench", *map(str, arguments)]) == 2
    return check_wrong_use(capsys.readouterr(), "")
