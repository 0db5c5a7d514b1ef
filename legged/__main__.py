"""`python -m legged` lists the commands."""

import sys
from pathlib import Path

import legged.tools
from legged.commandline.command import run_main
from legged.errors import ConfigError


def commands() -> dict[str, str]:
    """Return module -> the first line of what it says about itself, of all modules that can be run as `python -m`."""
    found = {}
    tools = Path(next(iter(legged.tools.__path__)))
    modules = {f"legged.tools.{path.stem}": path for path in sorted(tools.glob("*.py"))}
    modules["legged.deploy"] = tools.parent / "deploy" / "__main__.py"
    for name, path in modules.items():
        text = path.read_text(encoding="utf-8")
        if '__name__ == "__main__"' in text:
            summary = text.split('"""')[1].strip().splitlines()[0]
            found[name] = summary.partition(": `")[0].rstrip(".:")
    return found


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    given = sys.argv[1:] if argv is None else argv
    there = commands()
    if given and given not in (["--help"], ["-h"]):
        wanted = [name for name in there if name.rpartition(".")[2] == given[0]]
        raise ConfigError(
            f"python -m legged: takes no arguments, got '{given[0]}'"
            + (f"; did you mean python -m {wanted[0]}?" if wanted else "; without any it lists the commands")
        )
    print("commands, each with --help:")
    for name, summary in there.items():
        print(f"  python -m {name:30} {summary}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
