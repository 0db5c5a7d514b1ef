"""What there is to be used: tasks, robots and commands, read off the files alone, so that a list takes no time."""

from pathlib import Path

from legged.process.paths import data_folder

PACKAGE = Path(__file__).resolve().parents[1]
ON_ROBOTS = "legged.deploy"
"""The command that lies outside legged.tools: a robot's computer runs it without them."""


def tools() -> dict[str, str]:
    """Return module -> the first line of what it says about itself, of all modules that can be run as `python -m`."""
    files = {f"legged.tools.{path.stem}": path for path in sorted((PACKAGE / "tools").glob("*.py"))}
    files[ON_ROBOTS] = PACKAGE / "deploy" / "__main__.py"
    found = {}
    for name, path in files.items():
        text = path.read_text(encoding="utf-8")
        if '__name__ == "__main__"' in text:
            summary = text.split('"""')[1].strip().splitlines()[0]
            found[name] = summary.partition(": `")[0].rstrip(".:")
    return found


def module_of(tool: str) -> str:
    """Return the module with the `main` and the `build_parser` of a key of `tools`: of a package it is __main__."""
    return f"{tool}.__main__" if tool == ON_ROBOTS else tool


def tasks() -> dict[str, str]:
    """Return task -> the first sentence of the comment that its file begins with, of all tasks of this installation."""
    return {path.stem: _comment(path).partition(". ")[0].rstrip(".") for path in sorted(data_folder("cfg").glob("*.yaml"))}


def robots() -> dict[str, str]:
    """Return robot -> whose model it is, as its robot.yaml begins; empty where that has no such comment."""
    files = sorted((data_folder("resources") / "robots").glob("*/robot.yaml"))
    return {path.parent.name: _comment(path).partition(": ")[0].partition(". ")[0] for path in files}


def _comment(path: Path) -> str:
    """Return the comment at the head of a YAML file, without line ends."""
    found: list[str] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        found.append(line.lstrip("# "))
    return " ".join(found)
