"""Hooks of MkDocs: what of the site is not a page of docs/.

README.md and CONTRIBUTING.md become pages, with the pictures that pages show from other folders; links are written for GitHub
and are turned here. The notebook becomes a page. Tasks, commands and every field of the configuration are listed from the
code, and classes are documented from their source.
"""

import argparse
import json
import logging
import posixpath
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from legged.cli.list import robots, tasks
from legged.cli.main import COMMANDS, load
from legged.config.legged import LeggedConfig
from legged.config.reference import FieldText, fields

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
OUTSIDE = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md"}
"""Files of the repository's root -> the pages that they become."""
NOTEBOOK = "notebooks/first_walk.ipynb"
LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(\))")
COPIED = (".png", ".gif", ".jpg", ".svg", ".cff")
"""Endings of files outside docs/ that are copied to the site if a page links to them: pictures, and the citation."""
LONGEST_DEFAULT = 60
"""Characters of a default that stand in the table; longer ones follow the meaning."""
API = {
    "legged_robot": ("legged.envs.LeggedRobot", {"inherited_members": False}),
    "terms": (
        "legged.envs.velocity_terms.VelocityTerms",
        {"inherited_members": True, "filters": ["!^_", "^_(reward|obs|terminate|metric)_"]},
    ),
    "base_task": ("legged.envs.BaseTask", {}),
    "registry": ("legged.registry", {"members": ["register", "register_file", "task_config", "make_task", "task_class"]}),
    "physics": ("legged.physics.Physics", {}),
    "math": ("legged.math", {}),
}
"""Page -> what of the package it documents, and options of mkdocstrings."""
log = logging.getLogger("mkdocs.hooks.site")  # under strict, a warning ends the build


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made here, and the files that pages show from other folders."""
    for name, page in OUTSIDE.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / name)))
    made = {
        NOTEBOOK.replace(".ipynb", ".md"): notebook_page(),
        "reference/tasks.md": tasks_page(),
        "reference/commands.md": commands_page(),
        "reference/configuration.md": configuration_page(),
    }
    made |= {f"reference/{name}.md": api_page(*what) for name, what in API.items()}
    for page, text in made.items():
        files.append(File.generated(config, page, content=text))
    shown = {target for path in (*DOCS.glob("*.md"), *(ROOT / name for name in OUTSIDE)) for target in _copied(path)}
    for target in sorted(shown):
        files.append(File.generated(config, target, abs_src_path=str(ROOT / target)))
    return files


def _copied(path: Path) -> Iterator[str]:
    """Yield the files outside docs/ that a page shows and the site copies, relative to the repository."""
    for match in LINK.finditer(path.read_text(encoding="utf-8")):
        target = posixpath.normpath(posixpath.join(path.parent.relative_to(ROOT).as_posix(), match[2]))
        if target.endswith(COPIED) and not target.startswith("docs/") and "://" not in match[2]:
            yield target


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn the links of a page that are written for its place in the repository."""
    source = Path(page.file.abs_src_path or "")
    if not source.is_relative_to(ROOT) or source.suffix != ".md":
        return markdown
    here = source.parent.relative_to(ROOT).as_posix()
    beside = posixpath.dirname(page.file.src_uri) or "."

    def turned(match: re.Match[str]) -> str:
        if "://" in match[2] or match[2].startswith("mailto:"):
            return match[0]
        target = posixpath.normpath(posixpath.join(here, match[2]))
        at_site = OUTSIDE.get(target) or target.removeprefix("docs/").replace(NOTEBOOK, NOTEBOOK.replace(".ipynb", ".md"))
        if files.get_file_from_path(at_site) is None:
            log.warning("%s: the site has nothing for the link '%s'", source.relative_to(ROOT), match[2])
        return f"{match[1]}{posixpath.relpath(at_site, beside)}{match[3] or ''}{match[4]}"

    return "".join(part if part.startswith("```") else LINK.sub(turned, part) for part in _split(markdown))


def _split(markdown: str) -> list[str]:
    """Split a page into fenced blocks, which begin with a fence, and what is between them."""
    return re.split(r"^(```.*?^```$)", markdown, flags=re.DOTALL | re.MULTILINE)


def notebook_page() -> str:
    """Return the notebook as a page, code in blocks."""
    cells = json.loads((DOCS / NOTEBOOK).read_text(encoding="utf-8"))["cells"]
    texts = [("".join(cell["source"]), cell["cell_type"]) for cell in cells]
    return "\n\n".join(f"```python\n{text}\n```" if kind == "code" else text for text, kind in texts)


def tasks_page() -> str:
    """Return the page that lists tasks and robots, as `legged list` does."""
    lines = ["# Tasks", "", "`legged train NAME` trains one of them; `--show` prints what it consists of.", ""]
    lines += ["| task | what is learned |", "|---|---|", *(f"| `{name}` | {text} |" for name, text in tasks().items()), ""]
    lines += ["## Robots", "", "`robot: NAME` in a task's file takes one of them.", ""]
    return "\n".join(
        [*lines, "| robot | model |", "|---|---|", *(f"| `{name}` | {text} |" for name, text in robots().items())]
    )


def commands_page() -> str:
    """Return the page with what every command says of itself, its examples first."""
    lines = ["# Commands", "", "`legged --help` lists them; `python -m legged` is the same command."]
    pages = [(load(name), summary) for name, (_, summary) in COMMANDS.items() if name != "runs"]  # the same as `runs table`
    pages.append((import_module("legged.deploy.__main__"), "run a policy on a robot"))
    for command, summary in pages:
        parser = command.build_parser()
        lines += ["", f"## {parser.prog}", "", f"{summary}.", "", "```", *parser.examples, "```", ""]
        lines += ["| argument | |", "|---|---|", *_arguments(parser)]
    return "\n".join(lines)


def _arguments(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield rows of a table of a parser's arguments."""
    for action in parser._actions:
        if isinstance(action, argparse._HelpAction) or action.help == argparse.SUPPRESS:
            continue
        named = ", ".join(action.option_strings) or action.metavar or action.dest
        choices = f": {', '.join(map(str, action.choices))}" if action.choices else ""
        said = (action.help or "") + choices
        yield f"| {_code(named)} | {_escaped(said)} |"


def configuration_page() -> str:
    """Return the page with every field of a legged robot's configuration."""
    intro = (
        "Every field that a task's file, or `key=value` on the command line, can set. Tasks without `LeggedRobot` have the"
        " sections `env`, `sim`, `control`, `terminations`, `domain_rand`, `rewards`, `observations`, `train` and `custom`,"
        " and what their class adds. Defaults are those of the schema; `legged train NAME --show` prints a task's"
        " own. Maps merge with those of what is extended; lists and numbers replace them."
    )
    lines = ["# Configuration", "", intro]
    section = None
    for text in fields(LeggedConfig):
        if text.is_section:
            lines += ["", f"{'#' * min(text.path.count('.') + 2, 4)} {text.path.replace('<', '&lt;')}", "", text.meaning]
            section = None
            continue
        parent = text.path.rpartition(".")[0]
        if section != parent or section is None:
            section = parent
            lines += ["", *([] if parent else ["## Top level", ""]), "| field | takes | default | unit | bounds | meaning |"]
            lines += ["|---|---|---|---|---|---|"]
        lines.append(_row(text))
    return "\n".join(lines)


def _row(text: FieldText) -> str:
    """Return the row of a field."""
    default = json.dumps(text.default)
    long = len(default) > LONGEST_DEFAULT
    meaning = _escaped(text.meaning) + (f" Default: {_code(default)}." if long else "")
    name, shown = _code(text.path.rpartition(".")[2]), "see there" if long else _code(default)
    return f"| {name} | {_escaped(text.kind)} | {shown} | {text.unit} | {text.bounds} | {meaning} |"


def _code(text: str) -> str:
    """Return a text as code in a cell of a table."""
    return f"`{text}`".replace("|", "\\|")


def _escaped(text: str) -> str:
    """Return a text for a cell of a table, in which nothing but backquotes means something."""
    parts = re.split(r"(`[^`]*`)", text)
    marked = [part if part.startswith("`") else re.sub(r"([*_<\[\]])", r"\\\1", part) for part in parts]
    return "".join(marked).replace("|", "\\|").replace("\\<", "&lt;")


def api_page(what: str, options: dict[str, Any]) -> str:
    """Return a page that mkdocstrings fills from the source of the package."""
    lines = [f"# {what.rpartition('.')[2]}", "", f"::: {what}", "    options:", "      show_root_heading: false"]
    return "\n".join([*lines, *(f"      {key}: {json.dumps(value)}" for key, value in options.items()), ""])
