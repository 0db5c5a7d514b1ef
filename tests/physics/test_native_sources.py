"""The native sources of the fused launches: compilers take them, and their half for GPUs finds what that for the CPU does."""

import ctypes
import math
import re
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp
from mechanisms import EVERY_JOINT, FusedWorlds, packaged, random_motion, relative_error
from random_robots import EXTRAS, random_robot, rollout

from legged.physics.fused import constraint_solver, smooth_dynamics
from legged.physics.fused.constraint_solver import solver_constants, solver_kernel
from legged.physics.fused.contact_kernel import SOURCE as CONTACT_SOURCE
from legged.physics.fused.contact_kernel import StageArrays, stage_constants, stage_kernel
from legged.physics.fused.contact_stage import ContactStage
from legged.physics.fused.native import SOURCES, native_source
from legged.physics.fused.smooth_dynamics import DynamicsArrays, dynamics_constants, dynamics_kernel
from legged.physics.fused.solver_arrays import SolverArrays
from legged.physics.fused.tree import Tree

ARCHITECTURE = 90
"""An H100's."""
WARP_ON_CPU = Path(__file__).resolve().parents[1] / "warp_on_cpu.h"
SHIM = """
#include <cmath>
template <typename T> struct array_of { T* data; int shape[4]; };
template <int N> struct numbers { float x[N]; };
"""
"""What the sources know of Warp: arrays, with vectors and matrices as elements."""
SCALARS = {wp.int32: "int", wp.float32: "float", wp.bool: "bool", wp.uint64: "unsigned long long"}
NUMBERS = {wp.int32: ctypes.c_int, wp.float32: ctypes.c_float}
SETTINGS = {"solver": "", "dynamics": "", "contacts": "int found, "}
FILES = {"solver": constraint_solver.SOURCE, "dynamics": smooth_dynamics.SOURCE, "contacts": CONTACT_SOURCE}
STRUCTS = {"solver": SolverArrays, "dynamics": DynamicsArrays, "contacts": StageArrays}
GIVEN = {"solver": "", "dynamics": "", "contacts": "counted(all, world), "}
"""What a world is called with, beside its number and the arrays."""
COUNTED = """
int counted(const Arrays* all, int world) {  // contacts of a world, by those slots that have rows
    const int each = all->contact_dist.shape[0] / all->nefc.shape[0];
    int count = 0;
    for (int k = world * each; k < (world + 1) * each; ++k)
        count += all->contact_efc_address.data[k * all->contact_efc_address.shape[1]] >= 0;
    return count;
}
"""

needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")


def constants_of(file: str, model: mujoco.MjModel) -> dict[str, int | bool]:
    """Return those that a model gives to a source."""
    if file == "solver":
        return solver_constants(Tree.of(model), rows=40, entries=model.nM, damped=True, elliptic=True)
    if file == "contacts":
        return stage_constants(model, rows=40, slots=8, dim=6, frictions=True, limits=True)
    return dynamics_constants(model)


def array_type(kind: Any) -> str:
    """Return the type of arrays with elements of a Warp type."""
    return f"array_of<{SCALARS.get(kind) or f'numbers<{math.prod(kind._shape_)}>'}>"


def program(file: str, constants: dict[str, Any], on_gpu: bool) -> str:
    """Return a C++ program with the native source as a function, of a Warp struct for one."""
    types = {name: var.type for name, var in STRUCTS[file].vars.items()}
    fields = "".join(f"{SCALARS.get(kind) or array_type(kind.dtype)} {name};\n" for name, kind in types.items())
    function = f"void compute_world(int world, {SETTINGS[file]}Arrays arrays) {{\n{native_source(FILES[file], constants)}}}\n"
    return f"{WARP_ON_CPU.read_text() if on_gpu else ''}{SHIM}struct Arrays {{\n{fields}}};\n{function}"


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("on_gpu", [False, True])
@pytest.mark.parametrize("file", STRUCTS)
def test_a_compiler_takes_the_source_without_a_warning(tmp_path, file, on_gpu):
    source = tmp_path / "source.cpp"
    source.write_text(program(file, constants_of(file, mujoco.MjModel.from_xml_string(EVERY_JOINT)), on_gpu))
    # Unrolling is asked for in the words of NVIDIA's compiler.
    flags = ["-std=c++17", "-fsyntax-only", "-Wall", "-Werror", "-Wno-unknown-pragmas", "-Wno-unused-variable"]
    done = subprocess.run(["g++", *flags, str(source)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("file", STRUCTS)
def test_the_compiler_for_gpus_takes_the_kernel(tmp_path, file):
    """By NVIDIA's run-time compiler, which comes with Warp and needs no GPU."""
    constants = constants_of(file, mujoco.MjModel.from_xml_string(EVERY_JOINT))
    if file == "contacts":
        kernel = stage_kernel(constants, planes=True, pairs=True, ground=True)
    else:
        kernel = {"solver": solver_kernel, "dynamics": dynamics_kernel}[file](constants)
    try:
        (compiled,) = wp.compile_aot_module(kernel.module, arch=ARCHITECTURE, module_dir=tmp_path, use_ptx=True)
    except RuntimeError as error:
        if "CUDA" in str(error):
            pytest.skip(f"this Warp compiles nothing for a GPU: {error}")
        raise
    text = Path(compiled).read_text()
    assert f".target sm_{ARCHITECTURE}" in text
    assert "bar.warp.sync" in text  # the half for a GPU, in which lanes wait for each other


def test_a_macro_has_one_meaning_in_all_sources():
    meanings: dict[str, set[str]] = {}
    for path in SOURCES.glob("*.h"):
        for name in re.findall(r"#define (\w+)", path.read_text()):
            meanings.setdefault(name, set()).add(path.name)
    assert "EACH" in meanings
    assert all(len(files) == 1 for files in meanings.values()), meanings


class ArrayOf(ctypes.Structure):
    """An array as the program knows it."""

    _fields_ = [("data", ctypes.c_void_p), ("shape", ctypes.c_int * 4)]


def lanes_of(folder: Path, file: str, constants: dict[str, Any]) -> Any:
    """Compile the half for GPUs into a function of the number of worlds, the order of lanes and the struct's arrays."""
    call = f"compute_world(world, {GIVEN[file]}*all)"
    source = folder / f"{file}.cpp"
    source.write_text(
        program(file, constants, on_gpu=True)
        + "int worlds;\n"
        + (COUNTED if file == "contacts" else "")
        + f"void lane(void* with) {{ Arrays* all = (Arrays*)with; for (int world = 0; world < worlds; ++world) {call}; }}\n"
        + 'extern "C" bool compute(int count, bool backwards, Arrays* all) {\n'
        + "    worlds = count; return warp_on_cpu::run(lane, all, backwards);\n}\n"
    )
    library = folder / f"{file}.so"
    flags = ["-std=c++17", "-O1", "-shared", "-fPIC", "-w"]
    subprocess.run(["g++", *flags, str(source), "-o", str(library)], check=True)
    return ctypes.CDLL(str(library)).compute


def by_lanes(compute: Any, file: str, struct: Any, worlds: int, backwards: bool) -> None:
    """Compute worlds in the arrays of an instance of the file's Warp struct."""

    class Passed(ctypes.Structure):
        _fields_ = [(name, NUMBERS.get(var.type, ArrayOf)) for name, var in STRUCTS[file].vars.items()]

    passed = Passed()
    for name, kind in Passed._fields_:
        value = getattr(struct, name)
        if kind is ArrayOf:
            assert value.is_contiguous or not value.size
            value = ArrayOf(value.ptr, (ctypes.c_int * 4)(*value.shape))
        setattr(passed, name, value)
    compute.restype = ctypes.c_bool
    assert compute(worlds, backwards, ctypes.byref(passed)), "a lane waits where others do not"


def in_every_way(launch: Any, compute: Any, file: str, struct: Any, names: tuple[str, ...]) -> list[list[np.ndarray]]:
    """Return the arrays `names` of a struct as the kernel for the CPU leaves them, and as lanes do in either order, each from
    the sides of rows that the struct has now.
    """
    worlds = len(getattr(struct, names[0]))
    found = []
    sides = struct.last_rows.numpy().copy() if file == "solver" else None
    for way in (launch, *(lambda back=back: by_lanes(compute, file, struct, worlds, back) for back in (False, True))):
        for name in names:
            getattr(struct, name).fill_(np.nan)
        if sides is not None:
            struct.last_rows.assign(sides)
        way()
        found.append([getattr(struct, name).numpy().copy() for name in names])
    return found


def half_cheetah() -> FusedWorlds:
    """Six worlds from deep in the ground to above it."""
    model = packaged("half_cheetah.xml", timestep=0.01)
    fused = FusedWorlds(model, 6, rows=64)
    qpos, qvel, ctrl = random_motion(model, 6, seed=1)
    qpos[:, 1], qpos[:, 2:] = np.linspace(-0.7, 0.2, 6), 0.3 * qpos[:, 2:]
    fused.write(qpos, qvel, ctrl)
    return fused


def of_two_each(*extras: str) -> FusedWorlds:
    """Six worlds of a robot of so many degrees of freedom that lanes have two."""
    model = random_robot(0, 29, extras)
    states = rollout(model, seed=1, steps=300, every=50)
    fused = FusedWorlds(model, len(states), rows=150)
    fused.write(*(np.stack([state[name] for state in states]) for name in ("qpos", "qvel", "ctrl")))
    return fused


WORLDS = {
    "half cheetah": half_cheetah,
    "two degrees of freedom a lane": lambda: of_two_each("damping"),
    "with everything": lambda: of_two_each(*EXTRAS),
}


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("name", WORLDS)
def test_lanes_find_what_one_thread_finds(tmp_path, name):
    """The half for GPUs, on a warp of lanes that take turns. In which order they run between two meetings must not matter:
    that it does not, to the bit, shows that none is missing.
    """
    fused = WORLDS[name]()
    dynamics, solver = fused._step.dynamics, fused._step.solver
    compute = lanes_of(tmp_path, "dynamics", dynamics_constants(fused.model))
    names = ("geom_xpos", "geom_xmat", "cdof", "M", "qfrc_passive", "qfrc_actuator", "qfrc_smooth")
    if fused.model.neq:
        names = (*names, "xpos", "xquat", "cvel", "cdof_dot")
    results = in_every_way(dynamics.launch, compute, "dynamics", dynamics.arrays, names)
    compare(names, *results)

    assert fused._contacts is not None
    compare_stage(tmp_path, fused._contacts, lambda: fused.read("nefc"))

    for _ in range(2):  # makes the rows of constraints, which the solver then knows again
        fused.step()
    assert fused.active_set is not None
    assert fused.active_set.last.numpy()[:, 0].any() == solver.constants["KNOWN"]
    rows = fused.read("nefc")
    assert rows.min() < rows.max()
    assert name != "half cheetah" or rows.max() > 32  # a lane has two
    compute = lanes_of(tmp_path, "solver", solver.constants)
    names = ("qacc", "advance", "qfrc_constraint")
    compare(names, *in_every_way(solver.solve, compute, "solver", solver.arrays, names))


def compare_stage(folder: Path, stage: ContactStage, read_rows: Callable[[], np.ndarray]) -> None:
    """Check that lanes make the rows that one thread makes, and as many as it counts."""
    compute = lanes_of(folder, "contacts", stage.constants)
    names = ("jacobian", "stiffness", "reference", "contact_friction")
    stage.launch()
    ways = in_every_way(stage.launch, compute, "contacts", stage._arrays, names)
    equalities = stage._d.ne.numpy()  # mujoco-warp's own rows, which the lanes do not make
    for name, *found in zip(names, *ways, strict=True):  # what no row or contact needs stays as it was
        for array in found:
            for world, first in enumerate(equalities if name != "contact_friction" else ()):
                array[world, :first] = 0.0
        made = np.isfinite(found[0])
        assert all((np.isfinite(array) == made).all() for array in found), name
        compare([name], *([np.where(made, array, 0.0)] for array in found))
        if name == "stiffness":
            np.testing.assert_array_equal(made.sum(axis=1), read_rows())


@pytest.mark.slow
@needs_compiler
def test_lanes_make_rows_of_two_degrees_of_freedom_each(tmp_path):
    """A chain of 40 hinges with limits and dry friction, each link a capsule, lying across the floor."""
    link = (
        '<body pos="0 0 .1"><joint axis="0 1 0" range="-.1 .1" frictionloss=".1"/>'
        '<geom type="capsule" fromto="0 0 0 0 0 .1" size=".02"/>'
    )
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><compiler angle="radian"/><option jacobian="dense"/><worldbody><geom type="plane" size="0 0 1" contype="2"/>'
        + 40 * link.replace("<geom", '<geom contype="0" conaffinity="2"')
        + 40 * "</body>"
        + "</worldbody></mujoco>"
    )
    rng = np.random.default_rng(0)
    with wp.ScopedDevice("cpu"):
        m = mjw.put_model(model)
        d = mjw.make_data(model, nworld=4, nconmax=40, njmax=240)
        qpos = 0.08 * rng.normal(size=(4, 40))
        qpos[:, 0] += np.linspace(1.5, 1.7, 4)
        d.qpos.assign(np.float32(qpos))
        d.qvel.assign(np.float32(rng.normal(size=(4, 40))))
        for part in (mjw.kinematics, mjw.com_pos):
            part(m, d)
        assert ContactStage.why_not(model, m, d) == ""
        stage = ContactStage(model, m, d)
        compare_stage(tmp_path, stage, lambda: d.nefc.numpy())
    assert (d.nf.numpy() == 40).all()
    assert d.nl.numpy().min() > 0
    assert (d.nefc.numpy() - d.nf.numpy() - d.nl.numpy()).max() > 40  # more than ten contacts


def compare(names: Sequence[str], serial: list[np.ndarray], forwards: list[np.ndarray], backwards: list[np.ndarray]) -> None:
    """Check that lanes find the same in either order, and what one thread finds up to rounding."""
    for name, one, up, down in zip(names, serial, forwards, backwards, strict=True):
        assert np.isfinite(one).all(), name
        np.testing.assert_array_equal(up, down, err_msg=name)
        assert relative_error(up, one) < 1e-4, name
