"""Packages that are missing or of another version: one line for an error that nobody expected, and else its traceback."""

from importlib import metadata

import pytest

from legged.process.requirements import say_unmet, unmet


@pytest.fixture
def installed(monkeypatch):
    """installed(package=version): other versions than those that are there; None for a package that is not."""

    def installed(**versions):
        real = metadata.version

        def version(name):
            found = versions.get(name.replace("-", "_"), real)
            if found is None:
                raise metadata.PackageNotFoundError(name)
            return real(name) if found is real else found

        monkeypatch.setattr(metadata, "version", version)

    return installed


def test_what_is_installed_meets_every_requirement_here():
    assert unmet() == {}


def test_an_old_engine_is_named_whatever_went_wrong(installed, capsys):
    installed(mujoco="3.2.0", rsl_rl_lib="2.3.3")
    say_unmet(AttributeError, AttributeError("module 'mujoco' has no attribute\n'x'"), None)
    versions = "mujoco<4.1,>=4.0 (3.2.0 is installed), rsl-rl-lib<6,>=5.5 (2.3.3 is installed)"
    install = "pip install 'mujoco<4.1,>=4.0' 'rsl-rl-lib<6,>=5.5'"
    said = "AttributeError: module 'mujoco' has no attribute 'x'"
    printed = capsys.readouterr().err  # the traceback comes first: the cause may be another one
    assert (
        printed
        == f"AttributeError: module 'mujoco' has no attribute\n'x'\nerror: legged needs {versions}: {install} ({said})\n"
    )


def test_a_missing_package_is_named_after_a_failed_import_alone(installed, capsys):
    """A robot's computer lacks most packages, and other errors there have other causes."""
    installed(rich=None, onnx=None)
    say_unmet(ModuleNotFoundError, ModuleNotFoundError("No module named 'rich'"), None)
    expected = "error: legged needs onnx (missing), rich (missing): pip install 'onnx' 'rich' (ModuleNotFoundError: "
    assert capsys.readouterr().err == f"{expected}No module named 'rich')\n"
    say_unmet(KeyError, KeyError("a bug"), None)
    assert capsys.readouterr().err == "KeyError: 'a bug'\n"


def test_a_fault_of_the_program_keeps_its_traceback(capsys):
    try:
        raise KeyError("a bug")
    except KeyError as error:
        say_unmet(KeyError, error, error.__traceback__)
    assert "Traceback" in capsys.readouterr().err
