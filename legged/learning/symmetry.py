"""Learning from every sample and its mirror image (Mittal et al., arXiv 2403.04359)."""

import torch
from tensordict import TensorDict
from torch import Tensor

from legged.envs import BaseTask
from legged.mdp.mirror_images import MirrorImages


def images_of(task: BaseTask) -> MirrorImages:
    """Return the mirror images of a task's observations and actions.

    Raises:
        ConfigError: the task has no mirror images, or its table `MIRRORED` does not fit an observation term.
    """
    images = task.mirror_images()
    if images is None:
        text = f"{type(task).__name__} has no mirror images, so this must be false"
        raise task.cfg.origins.error("train.algorithm.symmetry", text)
    return images


def augment(
    images: MirrorImages, env: BaseTask, obs: TensorDict | None, actions: Tensor | None
) -> tuple[TensorDict | None, Tensor | None]:
    """Append to a batch its mirror image: (n, ...) -> (2 n, ...). rsl-rl's symmetry extension calls this function, with
    `images` already bound.
    """
    seen = done = None
    if obs is not None:
        both = {name: torch.cat([obs[name], obs[name][:, c] * s]) for name, (c, s) in images.groups.items()}
        seen = TensorDict(both, batch_size=[2 * obs.batch_size[0]], device=obs.device)
    if actions is not None:
        columns, signs = images.actions
        done = torch.cat([actions, actions[:, columns] * signs])
    return seen, done
