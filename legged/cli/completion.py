"""`legged completion`: a script that completes commands, options, tasks, runs and keys of the configuration."""

import argparse
import shlex
from collections.abc import Iterable
from importlib import import_module

import shtab

from legged.cli.main import COMMANDS, load
from legged.commandline.command import sub_command
from legged.config.reference import fields
from legged.deploy.command_parser import argument
from legged.envs import BaseTask
from legged.physics.fields import FIELDS
from legged.process.paths import data_folder
from legged.registry import CLASSES
from legged.terrain import TERRAIN_TYPES

NAMES = ("task", "policy", "other", "task_option", "runs", "load_run", "transfer", "teacher")
COMPLETED = {**dict.fromkeys(NAMES, "names"), "overrides": "keys"}
"""Argument -> kind of its values: `names` of tasks, policies and runs, or `keys` of the configuration."""
SCRIPT = """
_legged_names() {{ (cd {cfg} && printf '%s\\n' *.yaml | sed 's/[.]yaml$//'); ls -d logs/*/* 2>/dev/null | sed 's/^logs.//'; }}
_legged_keys() {{
cat <<'END'
{keys}
END
}}
# Print the keys that begin with $1, each up to the next dot after $1.
_legged_next_keys() {{ _legged_keys | sed -n "s/^\\\\($1[^.]*[.]\\\\{{0,1\\\\}}\\\\).*/\\\\1/p" | sort -u; }}
"""
IN_BASH = """
_legged_complete_names() { compgen -W "$(_legged_names)" -- "$1"; }
_legged_complete_keys() { _legged_next_keys "$1"; }
"""
LAST_IN_BASH = """
# After `legged evaluate` a policy may stand in the place of a sub-command. After a key no blank is added.
_legged_complete() {
  _shtab_legged "$@"
  if [[ ${COMP_WORDS[1]} == evaluate && $COMP_CWORD == 2 && $2 != -* ]]; then
    COMPREPLY+=($(_legged_complete_names "$2"))
  fi
  if [[ "${COMPREPLY[0]-}" == *[.=] ]]; then compopt -o nospace; fi
}
complete -o bashdefault -F _legged_complete legged
"""
IN_ZSH = """
_legged_complete_names() { compadd -- ${(f)"$(_legged_names)"} }
_legged_complete_keys() { compadd -S '' -- ${(f)"$(_legged_next_keys "$PREFIX")"} }
"""


@sub_command(
    "legged completion bash > ~/.legged-completion",
    "legged completion zsh > ~/.legged-completion",
    arguments=[argument("shell", choices=("bash", "zsh"), help="the shell that reads the script")],
)
def completion(args: argparse.Namespace) -> int:
    """Print a completion script for a shell: `legged completion bash > ~/.legged-completion`.

    The script completes commands, options, tasks, runs, and dotted keys of the configuration (`train.runner.<TAB>`). Source
    it in the shell's start-up file, and write it again after an update of the package.
    """
    kinds = [getattr(import_module(module), name) for name, module in CLASSES.items()]
    lists = SCRIPT.format(cfg=shlex.quote(str(data_folder("cfg"))), keys="\n".join(keys_of(kinds)))
    print(shtab.complete(whole_parser(), args.shell, preamble=lists + (IN_BASH if args.shell == "bash" else IN_ZSH)))
    if args.shell == "bash":
        print(LAST_IN_BASH)
    return 0


def whole_parser() -> argparse.ArgumentParser:
    """Return a parser of all commands. Arguments in `COMPLETED` hold the name of the shell function that completes them."""
    whole = argparse.ArgumentParser("legged")
    commands = whole.add_subparsers()
    groups: dict[str, argparse._SubParsersAction] = {}
    for name, (_, summary) in COMMANDS.items():
        group, _, inside = name.partition(" ")
        parser = load(name).build_parser()
        for action in parser._actions if name != "migrate" else ():  # `migrate --task` is a task of legged_gym
            if action.dest in COMPLETED:
                function = f"_legged_complete_{COMPLETED[action.dest]}"
                action.complete = {"bash": function, "zsh": function}  # type: ignore[attr-defined]
        if inside and group not in groups:
            parent = commands.choices.get(group) or commands.add_parser(group, help=f"commands of legged {group}")
            for action in parent._get_positional_actions():
                parent._remove_action(action)
            groups[group] = parent.add_subparsers()
        place = groups[group] if inside else commands
        place.add_parser(inside or group, help=summary, parents=[parser], add_help=False, conflict_handler="resolve")
    return whole


def keys_of(kinds: Iterable[type[BaseTask]]) -> list[str]:
    """Return `key=` for all settings of tasks of the classes `kinds`. If a setting is a table of terms, terrain types or
    properties of the model, each entry of the table has its own key.
    """
    found: set[str] = set()
    for kind in kinds:
        entries: dict[str, Iterable[str]] = {
            "rewards.scales": kind.terms("_reward_"),
            "observations.scales": kind.terms("_obs_"),
            "observations.noise": kind.terms("_obs_"),
            "domain_rand.ranges": FIELDS,
            **dict.fromkeys(("terrain.proportions", "terrain.sizes"), TERRAIN_TYPES),
        }
        for text in fields(kind.Config):
            if not text.is_section:
                found |= {f"{text.path.replace('<name>', group)}=" for group in ("actor", "critic")}
            found |= {f"{text.path}.{name}=" for name in entries.get(text.path, ())}
    return sorted(found)
