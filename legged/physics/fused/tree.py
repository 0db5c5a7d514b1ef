"""Elimination tree of the degrees of freedom. It tells which parts of a linear system can be solved in parallel."""

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np

CONNECT, WELD, JOINT = (int(getattr(mujoco.mjtEq, f"mjEQ_{name}")) for name in ("CONNECT", "WELD", "JOINT"))
SITE = int(mujoco.mjtObj.mjOBJ_SITE)
MOST_ROOT = 6
"""Largest number of degrees of freedom in the root (`Tree.root`). Each of the 32 lanes holds one entry of the root's
triangular matrix or right-hand side, which have 27 entries together for 6 degrees of freedom. Every lane then solves for the
root in its own registers."""
MOST_DOFS = 60
"""Largest number of degrees of freedom for which mujoco-warp keeps dense Jacobian rows. The solver would allow 64, because a
GPU lane can hold two degrees of freedom."""


@dataclass(frozen=True)
class Tree:
    """Elimination tree, stored as the parent of each degree of freedom. Parents precede their children."""

    parent: np.ndarray
    """(nv,) index of the parent; -1 for roots."""

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "Tree":
        """Return the elimination tree of a matrix with the non-zero entries of the mass matrix and of the model's equality
        constraints. If the matrix is eliminated from the last degree of freedom to the first, non-zero entries only arise
        between a degree of freedom and its ancestors (Davis, Direct Methods for Sparse Linear Systems, 2006, section 4.1).
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
        """(nv,) number of ancestors of each degree of freedom."""
        depth = np.zeros(len(self.parent), dtype=int)
        for i, parent in enumerate(self.parent):
            depth[i] = depth[parent] + 1 if parent >= 0 else 0
        return depth

    @property
    def root(self) -> int:
        """Number of leading degrees of freedom, up to `MOST_ROOT`, that are ancestors of all later ones."""
        most = min(MOST_ROOT, len(self.parent))
        for count in range(most, 0, -1):
            if (self.parent[:count] == np.arange(count) - 1).all() and (self.parent[count:] >= count - 1).all():
                return count
        return 0

    def path(self, i: int) -> list[int]:
        """Return the path to `i`: its ancestors from the root, then `i` itself."""
        path = [i]
        while self.parent[path[-1]] >= 0:
            path.append(int(self.parent[path[-1]]))
        return path[::-1]

    def constants(self) -> dict[str, int | bool]:
        """Return the constants of elimination.h."""
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
        """Return the tables of elimination.h.

        For each degree of freedom, `dof_depth` is its depth, `dof_place` its place among those of the same depth, and `path`
        its path as a bit mask. For each depth, `depth_width` is the number of degrees of freedom. Two tables (depths * nv,)
        have one number for each depth and degree of freedom. `dof_path` is the element of its path at that depth. `below` is
        the range of places of its descendants at that depth: the first place in the lowest byte, the end in the next byte.
        """
        nv, depth = len(self.parent), self.depth
        paths = [self.path(i) for i in range(nv)]
        at_depth = [np.flatnonzero(depth == t) for t in range(depth.max() + 1)]
        # Sorting by path makes the descendants of each degree of freedom adjacent.
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
    """Return a degree of freedom and its ancestors in the kinematic tree."""
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
    """Yield, for each equality constraint of bodies, sites or joints, the degrees of freedom that its rows couple."""
    for kind, of, *pair in zip(model.eq_type, model.eq_objtype, model.eq_obj1id, model.eq_obj2id, strict=True):
        if kind in (CONNECT, WELD):
            bodies = [model.site_bodyid[one] if of == SITE else one for one in pair]
            yield {dof for body in bodies for dof in _of_body(model, body)}
        elif kind == JOINT:
            yield {int(model.jnt_dofadr[joint]) for joint in pair if joint >= 0}
