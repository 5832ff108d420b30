"""The list of commands, and running one by its name."""

import os
import subprocess
import sys

import pytest

from experiments import __main__ as commands
from experiments.runner import cli


def test_the_list_names_every_command_in_a_line(capsys):
    commands.main([])
    listed = capsys.readouterr().out
    commands.main(["--help"])
    assert capsys.readouterr().out == listed
    rows = [line.split(maxsplit=1) for line in listed.splitlines()[2:]]
    assert {"pretrain", "finetune", "gaps"} <= {name for name, _ in rows} and all(words for _, words in rows)
    assert not {"__main__", "collect_operator", "studies"} & {name for name, _ in rows}


def test_a_command_that_does_not_exist_is_one_line_and_code_2(capsys):
    with pytest.raises(SystemExit) as stopped:
        commands.main(["pretrian"])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and "there is no 'pretrian', did you mean 'pretrain'?" in error
    assert error.count("\n") == 1


def test_a_command_gets_the_words_that_follow(capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["sgft"])
    monkeypatch.delitem(sys.modules, "experiments.tasks", raising=False)  # of another test
    with pytest.raises(SystemExit) as stopped:
        commands.main(["tasks", "nope"])
    assert stopped.value.code == 2 and "task: there is no 'nope'" in capsys.readouterr().err


SCRIPT, MODULE = ["python", "/usr/bin/sgft", "tasks"], ["python", "-m", "experiments", "tasks"]


@pytest.mark.parametrize(("line", "words"), [(SCRIPT, "sgft figures"), (MODULE, "python -m experiments.figures")])
def test_commands_in_hints_are_what_the_user_types(line, words, capsys, monkeypatch):
    monkeypatch.setattr("sys.orig_argv", line)
    assert cli.as_typed("next: python -m experiments.figures --out a") == f"next: {words} --out a"
    assert (
        cli.as_typed("python -m experiments.studies.tune") == "python -m experiments.studies.tune"
    )  # no script has it
    with pytest.raises(SystemExit):
        cli.fail("make one with: python -m experiments.figures")
    assert capsys.readouterr().err == f"error: make one with: {words}\n"


@pytest.mark.parametrize(
    ("line", "shown"),
    [([*SCRIPT, "--help"], "usage: sgft tasks "), ([*MODULE, "--help"], "usage: python -m experiments.tasks ")],
)
def test_the_usage_is_what_was_typed(line, shown, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["sgft"])
    monkeypatch.setattr("sys.orig_argv", line)
    monkeypatch.delitem(sys.modules, "experiments.tasks", raising=False)
    with pytest.raises(SystemExit):
        commands.main(["tasks", "--help"])
    assert capsys.readouterr().out.startswith(shown)


def test_the_list_may_lose_its_reader():
    """As after `| head`."""
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, "-m", "experiments"], stdout=write, stderr=subprocess.PIPE)
    os.close(write)
    assert (done.returncode, done.stderr) == (1, b"")
