"""The order in which a system of the degrees of freedom of a tree is solved, and what may be solved at once."""

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np

CONNECT, WELD, JOINT = (int(getattr(mujoco.mjtEq, f"mjEQ_{name}")) for name in ("CONNECT", "WELD", "JOINT"))
SITE = int(mujoco.mjtObj.mjOBJ_SITE)
MOST_ROOT = 6
"""Degrees of freedom of the root that each lane solves for by itself: their entries must find room in its registers, and
with the right-hand side those of a triangle of 6 are no more than there are lanes."""
MOST_DOFS = 60
"""mujoco-warp keeps the rows of a Jacobian whole up to so many; a lane of a GPU can have two, which would be 64."""


@dataclass(frozen=True)
class Tree:
    """Of each degree of freedom the one above it, all of which come before it."""

    parent: np.ndarray
    """(nv,) -1 where there is none."""

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "Tree":
        """Return the elimination tree of the mass matrix and of the model's equality constraints: a matrix that has their
        entries has, eliminated from the last degree of freedom to the first, no entry but between one and those above it
        (Davis, Direct Methods for Sparse Linear Systems, 2006, section 4.1).
        """
        above: list[set[int]] = [set(_chain(model, i)) - {i} for i in range(model.nv)]
        for clique in _coupled(model):
            for i in clique:
                above[i] |= {j for j in clique if j < i}
        parent = np.full(model.nv, -1)
        for i in range(model.nv - 1, -1, -1):
            if above[i]:
                parent[i] = max(above[i])
                above[parent[i]] |= above[i] - {parent[i]}
        return cls(parent)

    @property
    def depth(self) -> np.ndarray:
        """(nv,) how many are above."""
        depth = np.zeros(len(self.parent), dtype=int)
        for i, parent in enumerate(self.parent):
            depth[i] = depth[parent] + 1 if parent >= 0 else 0
        return depth

    @property
    def root(self) -> int:
        """How many of the first ones, up to `MOST_ROOT`, are above all that come after them."""
        count = 0
        while count < min(MOST_ROOT, len(self.parent)) and self.parent[count] == count - 1:
            if count and (self.parent[count:] < count - 1).any():
                break
            count += 1
        return count if (self.parent[count:] >= count - 1).all() else 0

    def path(self, i: int) -> list[int]:
        """Return those above `i`, from the first, and itself."""
        path = [i]
        while self.parent[path[-1]] >= 0:
            path.append(int(self.parent[path[-1]]))
        return path[::-1]

    def constants(self) -> dict[str, int | bool]:
        """Return what elimination.h asks for."""
        depth, root = self.depth, self.root
        triangle = root * (root + 1) // 2
        return {
            "ROOT": root,
            "DEPTH": int(depth.max()) + 1,
            "WIDTH": max(1, int(np.bincount(depth)[root:].max(initial=0))),
            "SPLIT": int(depth.max()) + 1 < len(depth),
            "TRIANGLE": triangle,
            "CORNER": triangle + root,
        }

    def tables(self) -> dict[str, np.ndarray]:
        """Return of each degree of freedom its depth, its place among those of the same depth, and the set of those on its
        path as bits of a number; of each depth how many have it; and of each depth and degree of freedom, (depths * nv,),
        what is there on its path, and which of that depth hang on it, from the lowest byte on: the place of the first, and
        that after the last.
        """
        nv, depth = len(self.parent), self.depth
        paths = [self.path(i) for i in range(nv)]
        at_depth = [np.flatnonzero(depth == t) for t in range(depth.max() + 1)]
        # Those that hang on one are side by side when sorted by their paths.
        at_depth = [np.array(sorted(those, key=lambda i: paths[i])) for those in at_depth]
        place, of_path, below = (
            np.zeros(nv, dtype=int),
            np.zeros((len(at_depth), nv), int),
            np.zeros((len(at_depth), nv), int),
        )
        for t, those in enumerate(at_depth):
            place[those] = np.arange(len(those))
            for i in range(nv):
                if t <= depth[i]:
                    of_path[t, i] = paths[i][t]
                hang = [n for n, k in enumerate(those) if i in paths[k]]
                below[t, i] = hang[0] | (hang[-1] + 1) << 8 if hang else 0
        return {
            "dof_depth": depth,
            "dof_place": place,
            "dof_path": of_path.ravel(),
            "below": below.ravel(),
            "depth_width": np.array([len(those) for those in at_depth]),
            "path": np.array([sum(1 << j for j in path) for path in paths], dtype=np.uint64),
        }


def _chain(model: mujoco.MjModel, dof: int) -> list[int]:
    """Return a degree of freedom and those above it in the mechanism."""
    chain = []
    while dof >= 0:
        chain.append(int(dof))
        dof = model.dof_parentid[dof]
    return chain


def _of_body(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the degrees of freedom that move a body."""
    while body and not model.body_dofnum[body]:
        body = model.body_parentid[body]
    return _chain(model, model.body_dofadr[body] + model.body_dofnum[body] - 1) if body else []


def _coupled(model: mujoco.MjModel) -> Iterable[set[int]]:
    """Yield the degrees of freedom that rows of each equality constraint of bodies, sites or joints move."""
    for kind, of, *pair in zip(model.eq_type, model.eq_objtype, model.eq_obj1id, model.eq_obj2id, strict=True):
        if kind in (CONNECT, WELD):
            bodies = [model.site_bodyid[one] if of == SITE else one for one in pair]
            yield {dof for body in bodies for dof in _of_body(model, body)}
        elif kind == JOINT:
            yield {int(model.jnt_dofadr[joint]) for joint in pair if joint >= 0}
