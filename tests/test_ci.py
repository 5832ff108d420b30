"""In CI a test may not be skipped because something that our extras bring is not installed."""

import importlib.util
import os
import sys
from pathlib import Path

import pytest
from _pytest.outcomes import importorskip  # pytest's own: in CI ours has replaced it already


@pytest.fixture(params=["true", ""], ids=["in CI", "elsewhere"])
def ours(request, monkeypatch):
    """`pytest.importorskip` as the settings of the tests leave it, and whether they are those of CI."""
    monkeypatch.setattr(os, "environ", {**os.environ, "CI": request.param})
    monkeypatch.setattr(pytest, "importorskip", importorskip)
    spec = importlib.util.spec_from_file_location("settings", Path(__file__).parent / "conftest.py")
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    return pytest.importorskip, bool(request.param)


def test_a_missing_extra_fails_in_ci_alone(ours):
    find, in_ci = ours
    with pytest.raises(ModuleNotFoundError if in_ci else pytest.skip.Exception, match="nowhere"):
        find("nowhere")


def test_what_no_extra_brings_may_be_missing_everywhere(ours, monkeypatch):
    find, _ = ours
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(pytest.skip.Exception, match="torch"):
        find("torch")
