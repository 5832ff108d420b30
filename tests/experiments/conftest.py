"""What tests of commands share."""

import os

import pytest

import envs
from experiments.runner import cli


@pytest.fixture
def toy_task(monkeypatch):
    """A task `toy`, and the settings of the tests instead of those of a command; the environment is as before after."""
    monkeypatch.setitem(envs.TASKS, "toy", "toy")
    monkeypatch.setattr(os, "environ", os.environ.copy())
    monkeypatch.setattr(cli, "set_up", lambda: None)
