"""torch's compiler is imported by who compiles, is then the real one, and knows what it would have known."""

import subprocess
import sys
from pathlib import Path

import pytest
from helpers import HANG_S

import legged

pytestmark = pytest.mark.slow

TRAIN = str(Path(legged.__file__).parents[1] / "train.py")
AS_A_COMMAND = f"import sys\nsys.argv = [{TRAIN!r}]\n"
DEFERRED = "'torch._dynamo.utils' not in sys.modules"


def run(code: str, *arguments: str, cwd: Path | None = None) -> str:
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_training_does_without_the_compiler_and_without_what_writes_its_report(tmp_path):
    settings = ["--task", "anymal_c_flat", "--sim_device", "cpu", "--num_envs", "2", "--max_iterations", "1", "sim.threads=1"]
    settings.append("train.runner.film=false")
    code = (
        f"{AS_A_COMMAND}sys.argv += {settings!r}\n"
        "from legged.cli.train import train\n"
        "assert train.main() == 0\n"
        "from legged.learning.report_process import wait_for_reports\n"
        "wait_for_reports()\n"
        "print([name for name in ('torch._dynamo.utils', 'torch._inductor', 'sympy', 'legged.evaluation.reports.document',"
        " 'legged.evaluation.reports.run_report') if name in sys.modules])\n"
    )
    assert run(code, cwd=tmp_path).splitlines()[-1] == "[]"


def test_who_compiles_gets_the_real_one_and_it_knows_of_all_marks():
    code = f"""{AS_A_COMMAND}
import legged.envs, torch, inspect
optimizer = torch.optim.Adam([torch.nn.Parameter(torch.ones(2))])
optimizer.zero_grad()
optimizer.step()
inspect.getmodule(run := lambda: 0)  # it looks at all modules
assert {DEFERRED}
stand_in = sys.modules["torch._dynamo"]
marked = [function for name, function in stand_in._marks if name == "allow_in_graph"]
assert marked and stand_in._not_disabled
double = torch.compile(lambda x: 2.0 * x, backend="eager")
assert double(torch.ones(3)).tolist() == [2.0, 2.0, 2.0]
real = sys.modules["torch._dynamo"]
assert real is torch._dynamo is not stand_in and real.optimize is stand_in.optimize
from torch._dynamo import trace_rules
assert all(id(function) in trace_rules._allowed_callable_ids for function in marked)
assert not any("__dynamo_disable" in vars(function) for function in stand_in._not_disabled)
optimizer.zero_grad()
assert torch.optim.Optimizer.zero_grad.__wrapped__.__dynamo_disable is not torch.optim.Optimizer.zero_grad.__wrapped__
"""
    run(code)


@pytest.mark.parametrize(
    ("version", "deferred"), [("2.13.1+cu130", True), ("2.12.1", False), ("2.130.0", False), ("3.0", False)]
)
def test_under_a_version_that_is_not_known_the_real_one_is_imported(version, deferred):
    code = f"""{AS_A_COMMAND}
import importlib.metadata
version = importlib.metadata.version
importlib.metadata.version = lambda name: {version!r} if name == "torch" else version(name)
import legged
assert ("torch._dynamo" in sys.modules) == {deferred}
"""
    run(code)


def test_a_torch_that_does_not_say_its_version_has_the_real_one():
    code = f"""{AS_A_COMMAND}
import importlib.metadata

def missing(name):
    raise importlib.metadata.PackageNotFoundError(name)

importlib.metadata.version = missing
import legged
assert "torch._dynamo" not in sys.modules
"""
    run(code)


def test_modules_inside_it_are_imported_once():
    code = f"""{AS_A_COMMAND}
import legged.envs, torch
assert {DEFERRED}
import torch._dynamo.config as found
from torch._dynamo import config
assert found is config is sys.modules["torch._dynamo.config"] is sys.modules["torch._dynamo"].config
assert found.__spec__.name == "torch._dynamo.config" and found.__spec__.origin.endswith("config.py")
from torch._dynamo.testing import CompileCounter  # which importing the package does not import
assert CompileCounter().frame_count == 0
"""
    run(code)


def test_who_only_imports_legged_has_the_real_one():
    finders = "[type(finder).__name__ for finder in sys.meta_path]"
    run(f"import sys, legged.envs, torch\nassert not ({DEFERRED})\nassert '_Submodules' not in {finders}")


def test_a_process_that_a_command_starts_collects_garbage_and_has_the_real_one(tmp_path):
    """It has the command's arguments, and nobody ends its start."""
    worker = tmp_path / "worker.py"
    worker.write_text(
        "import gc, sys\n"
        "def work(told):\n"
        "    import legged.envs, torch\n"
        "    told.put((gc.isenabled(), 'torch._dynamo.utils' in sys.modules))\n"
    )
    code = (
        f"{AS_A_COMMAND}sys.path.insert(0, {str(tmp_path)!r})\n"
        "import multiprocessing, legged, worker\n"
        "context = multiprocessing.get_context('spawn')\n"
        "told = context.Queue()\n"
        "process = context.Process(target=worker.work, args=(told,))\n"
        "process.start()\n"
        f"print(told.get(timeout={HANG_S}))\n"
    )
    assert run(code) == "(True, True)\n"
