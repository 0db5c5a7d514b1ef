"""What the README and the pages of docs/ show works: the example task, commands, links, and the shipped policies."""

import contextlib
import io
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from helpers import POLICY

from legged import registry
from legged.cli.evaluate import grid, terrain
from legged.cli.main import COMMANDS, load, split
from legged.cli.play import play
from legged.cli.train import train
from legged.commandline.command import OF_LEGGED_GYM
from legged.deploy import __main__ as program
from legged.deploy.command_parser import CommandParser
from legged.registry import import_tasks, make_task, task_config

ROOT = Path(__file__).resolve().parents[1]
PAGES = {path: path.read_text(encoding="utf-8") for path in (*ROOT.glob("*.md"), *sorted((ROOT / "docs").glob("*.md")))}
README = PAGES[ROOT / "README.md"]
TASKS = sorted(path.stem for path in (ROOT / "cfg").glob("*.yaml"))
ROUGH = ROOT / "resources" / "policies" / "anymal_c"


@pytest.mark.slow
def test_the_example_task_trains_without_touching_the_package(tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n# slip.py\n(.*?)```", README, flags=re.DOTALL)
    path = tmp_path / "readme_tasks.py"
    path.write_text(code, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "_REGISTERED", {})
    options = [
        "train.runner.report=false",
        "env.num_envs=4",
        "train.runner.num_steps_per_env=4",
        "--max-iterations",
        "1",
        "--sim-device",
        "cpu",
    ]
    assert train.main(["careful", "--import", str(path), *options]) == 0
    assert list(tmp_path.glob("logs/careful/*/model_0.pt"))

    import_tasks(str(path))
    task_config("careful")  # with a GPU's settings
    task = make_task(task_config("careful", [("env.num_envs", 2), ("sim.physics", "mujoco")], on_cpu=True))
    assert "foot_slip" in task.rewards.names


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 120


# ---- commands --------------------------------------------------------------------------------------------------------


class Shown(NamedTuple):
    """A command that a page shows."""

    line: int
    text: str
    in_a_block: bool
    """Whether it stands in a code block, complete, and not in a sentence or a table."""


PROGRAMS = ("legged", "python train.py", "python play.py", "python -m legged", "python -m legged.deploy")
BEGINS = re.compile(rf"({'|'.join(map(re.escape, sorted(PROGRAMS, key=len, reverse=True)))})(?= |$)")
PLACEHOLDER = re.compile(r"\.\.\.|<.*>|\[.*|.*\]|[A-Z][A-Z0-9_,]*")
"""A word that stands for what a user types: FILE, RUN, N, ..., [RUN."""
OPERATORS = ("&&", "||", "|", ";", ">", ">>", "<", "2>", "2>&1", "&")


def shown_commands(page: str) -> list[Shown]:
    """Return the commands in the code blocks and the inline code of a page."""
    found, outside, block = [], [], None
    for number, line in enumerate(page.splitlines(), 1):
        if line.lstrip().startswith("```"):
            found += [] if block is None else in_block(block)
            block = [] if block is None else None
        elif block is not None:
            block.append((number, line.strip()))
        outside.append("" if block is not None else line)
    for code in re.finditer(r"(?<!`)`([^`]+)`(?!`)", "\n".join(outside)):
        text = " ".join(code[1].replace("\\|", "|").split())
        if BEGINS.match(text) and " " in text:
            found.append(Shown("\n".join(outside).count("\n", 0, code.start()) + 1, text, False))
    return sorted(found)


def in_block(block: list[tuple[int, str]]) -> Iterator[Shown]:
    """Yield the commands of a code block; where some lines begin with the prompt `$`, the others are output."""
    with_prompt = any(line.startswith("$ ") for _, line in block)
    joined = ""
    for number, line in block:
        text = joined + (line.removeprefix("$ ") if joined or not with_prompt or line.startswith("$ ") else "")
        joined = f"{text[:-1]} " if text.endswith("\\") else ""
        for part in re.split(r"\s(?:&&|;|\|)\s", text) if not joined else ():
            if BEGINS.match(part.strip()):
                yield Shown(number, part.strip(), True)


def parser_for(words: list[str]) -> tuple[CommandParser | None, list[str]]:
    """Return the parser of the command that `words` begin with, None for the help of `legged` or of a group, and the words
    that it reads.

    Raises:
        LookupError: there is no such command.
    """
    if words[:3] == ["python", "-m", "legged.deploy"]:
        return program.build_parser(), words[3:]
    if words[:2] in (["python", "train.py"], ["python", "play.py"]):
        words = [words[1].removesuffix(".py"), *words[2:]]
    else:
        words = words[3:] if words[0] == "python" else words[1:]
    name, rest = split(words)
    if name is not None:
        return load(name).build_parser(), rest
    groups = {name.partition(" ")[0] for name in COMMANDS}
    rest = words[1:] if words and words[0] in groups else words
    if any(word != "--help" and not PLACEHOLDER.fullmatch(word) for word in rest):
        raise LookupError(f"there is no command '{' '.join(words[:2])}'")
    return None, rest


def mistake(command: Shown) -> str:
    """Return what is wrong with a command that is shown, an empty text if it is right."""
    words = shlex.split(command.text, comments=True)
    end = next((i for i, word in enumerate(words) if word in OPERATORS), len(words))
    try:
        parser, rest = parser_for(words[:end])
    except LookupError as error:
        return str(error)
    if parser is None:
        return ""
    options = [word.partition("=")[0] for word in rest if re.match(r"--\w", word)]
    known = {name.replace("_", "-") for name in parser._option_string_actions}
    unknown = [name for name in options if name not in parser._option_string_actions and name.replace("_", "-") not in known]
    if unknown:
        return f"there is no option {unknown[0]}"
    if any(PLACEHOLDER.fullmatch(word) for word in rest):
        return ""
    with contextlib.redirect_stderr(io.StringIO()) as said, contextlib.redirect_stdout(said):
        try:
            hyphened = [OF_LEGGED_GYM.sub(lambda option: option[0].replace("_", "-"), word) for word in rest]
            args = parser.parse_intermixed_args(hyphened)
        except SystemExit as stop:
            text = said.getvalue().strip().splitlines()[-1]
            unfinished = not command.in_a_block and "arguments are required" in text
            return "" if not stop.code or unfinished else text
    wrong = [word for word in getattr(args, "overrides", ()) if "=" not in word]
    return f"'{wrong[0]}' is neither an option nor key=value" if wrong else ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_that_is_shown_exists(page):
    found = shown_commands(PAGES[page])
    wrong = [f"{page.name}:{command.line}: {command.text}: {text}" for command in found if (text := mistake(command))]
    assert not wrong, "\n".join(wrong)


def test_commands_are_found_on_pages():
    assert sum(len(shown_commands(text)) for text in PAGES.values()) > 100
    block = "```\n$ legged play anymal_c \\\n  --gif  # films\nlegged 1.2\n```"
    page = f"Run `legged\ntrain TASK` or:\n\n{block}\n\n`legged`, `legged.cli`"
    assert shown_commands(page) == [
        Shown(1, "legged train TASK", False),
        Shown(6, "legged play anymal_c  --gif  # films", True),
    ]


@pytest.mark.parametrize(
    ("text", "in_a_block", "words"),
    [
        ("legged trian anymal_c", True, "there is no command 'trian anymal_c'"),
        ("legged episodes recrod anymal_c", True, "there is no command 'episodes recrod'"),
        ("legged evaluate gird anymal_c", True, "'anymal_c' is neither"),
        ("legged play POLICY --teraine pit", False, "there is no option --teraine"),
        ("legged train anymal_c --checkpoint last", True, "--checkpoint"),
        ("legged export", True, "required: POLICY"),
        ("python train.py --tsak anymal_c", True, "there is no option --tsak"),
        ("python -m legged.deploy --policy exported --robot go2", True, "there is no option --policy"),
        ("legged export", False, ""),
        ("legged runs [FOLDER ...]", False, ""),
        ("legged --help", True, ""),
        ("legged evaluate ...", False, ""),
        ("python train.py --task anymal_c --max_iterations 3 && ls", True, ""),
        ("legged completion bash > file", True, ""),
        ("python -m legged.deploy exported --robot go2", True, ""),
    ],
)
def test_what_is_wrong_with_a_command_is_found(text, in_a_block, words):
    said = mistake(Shown(1, text, in_a_block))
    assert words in said
    assert bool(words) == bool(said)


OTHERS = ("migrating.md", "from_isaac_lab.md", "from_mjlab.md")
"""Pages that name the options of other packages."""


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "CHANGELOG.md"], ids=lambda page: page.name)
def test_no_page_speaks_of_commands_that_have_gone(page):
    gone = ["legged.tools", "legged-train", *([] if page.name in OTHERS else ["--load_run"])]
    lines = enumerate(PAGES[page].splitlines(), 1)
    assert not [f"{page.name}:{number}: {word}" for number, line in lines for word in gone if word in line]


# ---- links and policies ----------------------------------------------------------------------------------------------


def test_links_and_pictures_are_there():
    for page, text in PAGES.items():
        for target in re.findall(r"\]\((?!http)([^)]+)\)", text):
            path = (page.parent / target.partition("#")[0]).resolve()
            assert path.is_file(), f"{page.name}: {target}"


def test_paths_in_the_text_are_there():
    """Whatever is written as code and begins with a folder of the repository is one of its files, or a task in Gymnasium."""
    for page, text in PAGES.items():
        for path in re.findall(r"`((?:legged|tests|docs|cfg|resources)/[\w./-]+)`", text):
            of_gymnasium = path.removeprefix("legged/") in TASKS
            assert (ROOT / path).exists() or of_gymnasium, f"{page.name}: {path}"


@pytest.mark.slow
def test_shipped_policy_follows_commands_in_c_mujoco(tmp_path, capsys):
    axes = ["--vx=-1:1:1", "--vy=-1:1:1", "--yaw=-1:1:1", "--robots", "1", "--physics", "mujoco"]
    assert grid.main([str(POLICY), "--out", str(tmp_path), *axes]) == 0
    result = json.loads((tmp_path / "evaluation_mujoco.json").read_text())
    # 27 of the 125 cells, one robot each instead of 16: the corners and the axes, the hardest part of the grid.
    assert result["rmse_lin"]["mean"] < 0.10
    assert result["rmse_ang"]["mean"] < 0.12
    assert result["falls"] == 0.0


@pytest.mark.slow
def test_shipped_policy_climbs_stairs_in_c_mujoco(tmp_path, monkeypatch):
    """Six robots of each step height; up to 0.15 m, all of them. 0.3 m is beyond what it can, so the test can tell."""
    monkeypatch.chdir(tmp_path)
    where = [str(ROUGH), "--physics", "mujoco", "--out", "."]
    assert terrain.main([*where, "--types", "stairs_up", "--robots-per-point", "6"]) == 0
    assert grid.main([*where, "--vx=0.5", "--vy=0", "--yaw=0", "--robots", "4"]) == 0
    result = json.loads(Path("evaluation_mujoco.json").read_text())
    share = {point["size"]: point["share"] for point in result["success"]["types"]["stairs_up"]["points"]}
    assert share[0.05] == share[0.1] == share[0.15] == 1.0
    assert share[0.3] < 1.0
    assert result["rough"]["rmse_lin"]["mean"] < 0.15
    assert result["rough"]["falls"] == 0.0


@pytest.mark.parametrize("policy", sorted(ROUGH.parent.iterdir()), ids=lambda path: path.name)
def test_shipped_checkpoint_is_finite_and_of_its_task(policy):
    saved = torch.load(policy / "model.pt", weights_only=True, map_location="cpu")
    assert saved["infos"]["task"] == policy.name
    assert all(torch.isfinite(tensor).all() for tensor in saved["actor_state_dict"].values())


@pytest.mark.slow
def test_a_policy_without_its_optimiser_is_exported(tmp_path):
    """As the one for rough terrain is shipped."""
    assert "optimizer_state_dict" not in torch.load(ROUGH / "model.pt", weights_only=True, map_location="cpu")
    arguments = [str(ROUGH), "--out", str(tmp_path), "--no-video", "--headless"]
    assert play.main([*arguments, "--terrain", "flat", "--num-envs", "1"]) == 0
    described = json.loads((tmp_path / "exported" / "policy.json").read_text())
    assert sum(term["size"] for term in described["observation"]) == 235
    assert described["observation_history"] == 1
