"""Settings by the names that they used to have."""

import pytest
from helpers import small_config

from legged.config import from_dict, load_config, override
from legged.config.renamed import RENAMED, renamed
from legged.errors import ConfigError


def test_old_names_mean_what_they_did(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("extends: anymal_c_flat\nobservations: {actor: [dof_pos], actor_history: 3, critic: [dof_vel]}\n")
    groups = load_config(path, "mine").observations.groups
    assert (groups["actor"].terms, groups["actor"].history, groups["actor"].noise) == (("dof_pos",), 3, True)
    assert (groups["critic"].terms, groups["critic"].history, groups["critic"].noise) == (("dof_vel",), 1, False)


def test_a_configuration_that_an_older_version_wrote_is_read():
    cfg = from_dict({"observations": {"actor": ["dof_pos"], "actor_history": 2, "critic": ["dof_pos"], "clip": 5.0}})
    assert (cfg.observations.groups["actor"].history, cfg.observations.clip) == (2, 5.0)


def test_a_child_by_new_names_extends_a_parent_by_old_ones(tmp_path):
    (tmp_path / "parent.yaml").write_text("extends: anymal_c_flat\nobservations: {actor: [dof_pos], actor_history: 4}\n")
    child = tmp_path / "child.yaml"
    child.write_text(
        "extends: parent\nobservations: {groups: {actor: {terms: [dof_vel]}}}\ncpu: {observations: {critic: [dof_pos]}}\n"
    )
    actor = load_config(child, "child").observations.groups["actor"]
    assert (actor.terms, actor.history) == (("dof_vel",), 4)
    assert load_config(child, "child", on_cpu=True).observations.groups["critic"].terms == ("dof_pos",)


def test_overrides_by_old_names_are_taken_and_checked_by_new_ones():
    cfg = override(small_config(), [("observations.actor_history", 5)])
    assert cfg.observations.groups["actor"].history == 5
    with pytest.raises(ConfigError, match=r"command line: observations\.groups\.actor\.history: must be at most 1000"):
        override(small_config(), [("observations.actor_history", 1001)])


@pytest.mark.parametrize("old", RENAMED)
def test_a_setting_by_both_names_is_refused(old):
    section, key = old.split(".")
    data: dict = {section: {key: 1}}
    inner = data
    *way, last = RENAMED[old].split(".")
    for part in way:
        inner = inner.setdefault(part, {})
    inner[last] = 2
    with pytest.raises(ConfigError, match=rf"mine: {old}: 1: renamed to {RENAMED[old]}, which is set too"):
        renamed(data, "mine")


def test_a_setting_by_both_names_with_one_value_is_read():
    assert from_dict({"observations": {"clip": 5.0, "actor_history": 2, "groups": {"actor": {"history": 2}}}})


def test_what_is_given_is_not_changed():
    data = {"observations": {"actor": ["dof_pos"]}}
    assert renamed(data, "mine") == {"observations": {"groups": {"actor": {"terms": ["dof_pos"]}}}}
    assert data == {"observations": {"actor": ["dof_pos"]}}


def test_what_is_no_map_is_left_to_the_schema():
    for data in ({"observations": 3}, {"observations": {"actor": [], "groups": 3}}):
        with pytest.raises(ConfigError):
            from_dict(data)


@pytest.mark.parametrize(
    ("sim", "step"),
    [
        ({"constraint_solver": "auto", "smooth_dynamics": "auto"}, "auto"),
        ({"constraint_solver": "rounds"}, "library"),
        ({"smooth_dynamics": "stages"}, "library"),
        ({"constraint_solver": "fused", "smooth_dynamics": "fused"}, "fused"),
        ({"smooth_dynamics": "fused", "step": "fused"}, "fused"),
    ],
)
def test_two_old_knobs_are_one_now(sim, step):
    assert from_dict({"sim": {**sim, "dt": 0.004}}).sim.step == step


@pytest.mark.parametrize(
    ("sim", "text"),
    [
        ({"constraint_solver": "rounds", "smooth_dynamics": "fused"}, "now means sim.step=fused, but sim.step is 'library'"),
        ({"constraint_solver": "fast"}, "replaced by sim.step, which can be auto, fused or library; got 'fast'"),
        ({"constraint_solver": ["rounds"]}, "replaced by sim.step"),
    ],
)
def test_old_knobs_that_contradict_each_other_or_mean_nothing_are_refused(sim, text):
    with pytest.raises(ConfigError, match=text):
        from_dict({"sim": sim})
