"""Packages that this package needs: what a command says if one of them is missing or has another version."""

import sys
from pathlib import Path
from types import TracebackType

MISSING = "missing"


def unmet() -> dict[str, str]:
    """Return requirement -> what is installed instead, for each requirement that this Python environment does not meet."""
    # These modules are imported here, because only errors need them.
    import tomllib
    from importlib import metadata

    from packaging.requirements import Requirement

    project = Path(__file__).resolve().parents[2] / "pyproject.toml"
    if project.is_file():
        texts = tomllib.loads(project.read_text(encoding="utf-8"))["project"]["dependencies"]
    else:
        texts = metadata.requires("legged") or []
    found = {}
    for requirement in map(Requirement, texts):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            version = metadata.version(requirement.name)
        except metadata.PackageNotFoundError:
            found[f"{requirement.name}{requirement.specifier}"] = MISSING
            continue
        if not requirement.specifier.contains(version, prereleases=True):
            found[f"{requirement.name}{requirement.specifier}"] = f"{version} is installed"
    return found


def say_unmet(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print an error that nothing has caught. If requirements are unmet, a line names them; a failed import then has no
    traceback. The arguments are those of `sys.excepthook`.
    """
    at_import = isinstance(error, ImportError)
    try:
        found = {text: what for text, what in unmet().items() if what != MISSING or at_import}
    except Exception:  # without `packaging` or the list of requirements, nothing is known
        found = {}
    if not (found and at_import):
        sys.__excepthook__(kind, error, trace)
    if not found:
        return
    packages = ", ".join(f"{text} ({what})" for text, what in found.items())
    install = " ".join(f"'{text}'" for text in found)
    said = " ".join(str(error).split())[:200]
    print(f"error: legged needs {packages}: pip install {install} ({kind.__name__}: {said})", file=sys.stderr, flush=True)
