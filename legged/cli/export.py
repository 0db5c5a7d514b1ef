"""`legged export`: ONNX files of a run."""

import argparse
from pathlib import Path

import torch

from legged.commandline.arguments import POLICY, policy_overrides, register_given, settle_on
from legged.commandline.command import sub_command
from legged.config import override
from legged.deploy.command_parser import argument
from legged.errors import ConfigError
from legged.learning.checkpoint import read_checkpoint
from legged.learning.run_folder import checkpoints
from legged.policies import export as exporting
from legged.policies.formats import FORMATS, export_as
from legged.policies.restore import policy_of, restore, undisturbed
from legged.process.paths import ready_to_write, relative


@sub_command(
    "legged export go1_flat --out policies",
    "legged export anymal_c_flat/2026-11-22_05-38-19",
    "legged export go2_real --format unitree",
    arguments=(
        *POLICY,
        argument("--format", choices=FORMATS, default=FORMATS[0], help=f"program that reads the files; default {FORMATS[0]}"),
        argument(
            "--out",
            type=Path,
            help="folder for the files; by default exported/ in the run folder (shipped policy: in logs/export/<task>), with"
            " the format in its name if it is not legged",
        ),
    ),
)
def export(args: argparse.Namespace) -> int:
    """Export every checkpoint of a run: `legged export go1_flat`.

    Each checkpoint is exported to a folder <iterations>/ with policy.onnx, policy.pt, policy.weights and policy.json.
    policy.onnx and policy.json state the number of iterations, and the time `wall_s` from the start of the training process
    to the checkpoint [s]. `legged evaluate onnx --rmse` finds the first of these policies that walks. To export a single
    checkpoint, use `legged play`.

    A policy that tracks motions has a file policy_<motion>.onnx besides, for each motion. `legged motion` reads the motion
    in this file, and `legged evaluate onnx` replays it.

    With --format mjlab or unitree, each folder has a policy.onnx with mjlab's metadata, and for unitree a deploy.yaml. With
    --format league, it has policies/<task>/ for the G1 walking league. What the format cannot express is an error.
    """
    register_given(args, "policy")
    if args.checkpoint is not None:
        raise ConfigError("--checkpoint: leave it out, because all checkpoints of the run are exported")
    device = torch.device("cpu")
    settle_on(device)
    policy = policy_of(args.policy)
    paths = checkpoints(policy.folder)
    if not paths:
        raise ConfigError(f"POLICY: {relative(policy.folder)} contains no checkpoint")
    suffix = "" if args.format == FORMATS[0] else f"_{args.format}"
    folder = args.out or policy.output("export") / f"{exporting.EXPORTED}{suffix}"
    asked = policy_overrides(args)
    ready_to_write(folder, exporting.megabytes(override(policy.cfg, asked)) * len(paths))
    # An export simulates nothing. A task with one robot in C MuJoCo is built fastest, because it needs no kernels.
    changes = [*undisturbed(policy.cfg, 1), ("sim.physics", "mujoco"), *asked]
    task, act = restore(policy, changes, device, graph=False)
    for path in paths.values():
        training: dict[str, float] = {"iterations": act.load(path)}
        into = folder / f"{training['iterations']:05d}"
        if args.format != FORMATS[0]:
            export_as(task, act.network, into, args.format, relative(policy.folder))
            continue
        seconds = read_checkpoint(path)["infos"].get("wall_s")
        if isinstance(seconds, int | float):
            training["wall_s"] = seconds
        exporting.export(task, act.network, into, training, policy.cfg, relative(policy.folder))
    print(f"exported {len(paths)} checkpoint{'s' if len(paths) != 1 else ''} to {relative(folder)}")
    return 0
