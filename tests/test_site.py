"""The documentation as a site: every page has its place, nothing is fetched from elsewhere, links lead somewhere, and what is
made from the code is all there.
"""

import html
import importlib.util
import logging
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote, urlparse

import pytest
import yaml

from legged.cli.list import robots, tasks
from legged.cli.main import COMMANDS, load
from legged.config.legged import LeggedConfig
from legged.config.reference import fields

ROOT = Path(__file__).resolve().parents[1]
CONFIG = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
needs_mkdocs = pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("mkdocs", "material", "mkdocstrings")), reason="needs the extra docs"
)


def in_nav(entries) -> list[str]:
    """Return the pages of a part of the navigation."""
    found = []
    for entry in entries:
        for value in entry.values():
            found += in_nav(value) if isinstance(value, list) else [value]
    return found


def test_every_page_has_one_place_in_the_navigation():
    pages = in_nav(CONFIG["nav"])
    assert len(pages) == len(set(pages))
    of_docs = {page for page in pages if not page.startswith(("reference/", "notebooks/"))}
    written = {path.name for path in (ROOT / "docs").glob("*.md")}
    assert of_docs - {"index.md", "contributing.md"} == written  # those two are README.md and CONTRIBUTING.md


def build(config: Path, out: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mkdocs", "build", "--config-file", str(config), "--site-dir", str(out)]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Return the folder of the built site."""
    out = tmp_path_factory.mktemp("site")
    done = build(ROOT / "mkdocs.yml", out)
    assert done.returncode == 0, done.stderr[-3000:]
    return out


class Reader(HTMLParser):
    """What a page fetches, what it links to, and its anchors."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.fetched, self.links, self.anchors, self.text = set(), set(), {""}, []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.anchors |= {given[name] for name in ("id", "name") if given.get(name)}
        if tag == "a":
            self.links |= {given["href"]} if given.get("href") else set()
        elif tag != "link" or given.get("rel") not in ("canonical", "next", "prev"):
            self.fetched |= {given[name] for name in ("src", "href", "data", "poster") if given.get(name)}

    def handle_data(self, data):
        self.text.append(data)


@pytest.mark.slow
@needs_mkdocs
def test_nothing_is_fetched_from_elsewhere_and_all_links_lead_somewhere(site):
    pages = {path.resolve(): Reader(path) for path in site.rglob("*.html") if path.name != "404.html"}
    assert len(pages) > 25
    for path, page in pages.items():
        assert page.fetched
        for address in page.fetched | page.links:
            parts = urlparse(address)
            if parts.scheme in ("http", "https", "mailto", "data"):
                assert address not in page.fetched or parts.scheme == "data", f"{path.name} fetches {address}"
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            assert target.is_file(), f"{path.name}: {address}"
            if target.suffix == ".html":
                assert unquote(parts.fragment) in pages[target].anchors | {"__skip", "__nojs"}, f"{path.name}: {address}"
    for path in site.rglob("*.css"):
        assert not re.search(r"(@import|url\()\s*[\"']?(https?:)?//", path.read_text(encoding="utf-8")), path.name


@pytest.mark.slow
@needs_mkdocs
def test_what_is_made_from_the_code_is_complete(site):
    said = {name: html.unescape((site / "reference" / f"{name}.html").read_text(encoding="utf-8")) for name in PAGES}
    for text in fields(LeggedConfig):
        shown = f">{text.path}<a" if text.is_section else f"<code>{text.path.rpartition('.')[2]}</code>"
        assert shown in said["configuration"], text.path
    for name in (*tasks(), *robots()):
        assert f"<code>{name}</code>" in said["tasks"]
    for name in COMMANDS:
        assert f'id="{load(name).build_parser().prog.replace(" ", "-")}"' in said["commands"]
    for name, anchor in PAGES.items():
        assert f'id="{anchor}"' in said[name]


PAGES = {
    "configuration": "trainrunner",
    "tasks": "robots",
    "commands": "legged-completion",
    "legged_robot": "legged.envs.LeggedRobot.hold_commands",
    "terms": "legged.envs.velocity_terms.VelocityTerms._reward_tracking_lin_vel",
    "base_task": "legged.envs.BaseTask.step",
    "registry": "legged.registry.register",
}
"""Page of the reference -> an anchor that it must have."""


@pytest.mark.slow
@needs_mkdocs
def test_a_field_is_shown_with_default_unit_bounds_and_meaning(site):
    text = " ".join(Reader(site / "reference" / "configuration.html").text)
    assert re.search(
        r"push_interval_s\s+a number\s+15\.0\s+s\s+at least 1e-05, at most 1e\+09\s+Time between two pushes", text
    )


@pytest.mark.slow
@needs_mkdocs
@pytest.mark.parametrize(
    ("page", "fine"), [("[here](page.md)", True), ("[away](nowhere.md)", False), ("[up](page.md#no)", False)]
)
def test_a_wrong_link_ends_the_build(tmp_path, page, fine):
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "page.md").write_text(f"# Page\n\n{page}\n", encoding="utf-8")
    (tmp_path / "mkdocs.yml").write_text(
        f"INHERIT: {ROOT / 'mkdocs.yml'}\ndocs_dir: docs\nhooks: []\nplugins: []\nextra_css: []\nnav: [page.md]\n"
    )
    assert (build(tmp_path / "mkdocs.yml", tmp_path / "out").returncode == 0) == fine


@pytest.mark.slow
@needs_mkdocs
@pytest.mark.parametrize(
    ("source", "place", "text", "expected"),
    [
        ("README.md", "index.md", "[a](docs/tasks.md)", "[a](tasks.md)"),
        ("README.md", "index.md", "[a](docs/tasks.md#x) ![b](resources/a.png)", "[a](tasks.md#x) ![b](resources/a.png)"),
        ("docs/terrain.md", "terrain.md", "![b](../resources/a.png)", "![b](resources/a.png)"),
        (
            "docs/tasks.md",
            "tasks.md",
            "[c](../CONTRIBUTING.md), [d](https://x.y/z)",
            "[c](contributing.md), [d](https://x.y/z)",
        ),
        ("docs/tasks.md", "tasks.md", "[n](notebooks/first_walk.ipynb)", "[n](notebooks/first_walk.md)"),
        ("docs/tasks.md", "tasks.md", "```\n[a](../CONTRIBUTING.md)\n```", "```\n[a](../CONTRIBUTING.md)\n```"),
        ("docs/tasks.md", "tasks.md", "[c](../LICENSE)", None),
    ],
)
def test_links_written_for_github_are_turned(source, place, text, expected, caplog):
    spec = importlib.util.spec_from_file_location("site_hooks", ROOT / "docs" / "site_hooks.py")
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    there = ("tasks.md", "terrain.md", "contributing.md", "index.md", "notebooks/first_walk.md", "resources/a.png")
    files = SimpleNamespace(get_file_from_path=lambda path: path if path in there else None)
    page = SimpleNamespace(file=SimpleNamespace(abs_src_path=str(ROOT / source), src_uri=place))
    with caplog.at_level(logging.WARNING):
        turned = hooks.on_page_markdown(text, page, None, files)
    if expected is None:
        assert "the site has nothing for the link '../LICENSE'" in caplog.text
    else:
        assert (turned, caplog.text) == (expected, "")
