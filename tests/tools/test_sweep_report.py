"""The table of a sweep: what it says of trials that were ended early."""

from pathlib import Path

import pytest
import yaml

from legged.tools.sweeping.plan import plan_sweep, read_sweep
from legged.tools.sweeping.report import table

optuna = pytest.importorskip("optuna", reason="the extra 'sweep' is not installed")
pytestmark = pytest.mark.usefixtures("workplace")


@pytest.mark.parametrize(
    ("objective", "reported", "said"),
    [
        ({"figure": "return", "take": "last"}, -820.0, "-820 at 10"),
        ({"figure": "return", "take": "last"}, 820.0, "820 at 10"),
        ({"figure": "return", "take": "time", "target": 5.0}, 820.0, "-820 at 10"),  # there the worker negates returns
        ({"figure": "return", "take": "time", "target": 5.0}, -3.5, "3.5 at 10"),
    ],
)
def test_a_trial_that_was_ended_early_stands_with_the_figure_it_had(objective, reported, said):
    parameters = {"train.algorithm.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}}
    given = {"task": "half_cheetah", "trials": 3, "objective": objective, "parameters": parameters}
    path = Path("mine.yaml")
    path.write_text(yaml.safe_dump(given))
    plan = plan_sweep(read_sweep(path), path, on_cpu=True)
    trial = optuna.trial.create_trial(state=optuna.trial.TrialState.PRUNED, intermediate_values={5: 1.0, 10: reported})
    assert f"; {said} |" in table(plan, [trial])
