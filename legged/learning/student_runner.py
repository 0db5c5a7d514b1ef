"""Training of a student, which learns to act like a teacher, in the loop of CapturedRunner."""

from pathlib import Path
from typing import Any

from legged.envs import BaseTask
from legged.errors import ConfigError
from legged.learning.captured import CapturedRunner
from legged.learning.checkpoint import describe_mismatch
from legged.learning.display import Display
from legged.learning.networks import actor_settings, network_settings
from legged.learning.rollout import Steps
from legged.learning.runner import loop_settings
from legged.learning.student_rollout import StudentRollout
from legged.learning.teacher import Teacher


class StudentRunner(CapturedRunner):
    """CapturedRunner for a student. Checkpoints hold the student (as the actor) and the teacher, but no critic."""

    ALGORITHM = "legged.learning.distillation:DeviceDistillation"

    def __init__(
        self,
        env: BaseTask,
        teacher: Teacher,
        log_dir: Path | None = None,
        device: str = "cpu",
        display: Display | None = None,
    ) -> None:
        """Take the student's task `env`, which must have the teacher's observations too (see `with_teacher`).

        Raises:
            ConfigError: the teacher's weights do not fit its network.
        """
        self.teacher = teacher
        super().__init__(env, log_dir, device, display)
        weights = dict(teacher.weights)
        try:
            self.alg.teacher.load_state_dict(weights)
        except RuntimeError as error:
            path, wanted = Path(str(teacher.origin["file"])), self.alg.teacher.state_dict()
            raise ConfigError(describe_mismatch(path, {"actor_state_dict": weights}, wanted, env.cfg.task)) from error
        self.alg.teacher_loaded = True

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train for a number of iterations."""
        if self.why_stock:  # rsl-rl's own loop starts its update from `last_hidden_states`
            self.alg.last_hidden_states = (self.alg.student.get_hidden_state(), None)
        super().learn(num_learning_iterations, init_at_random_ep_len)

    def _configuration(self, env: BaseTask) -> dict[str, Any]:
        train = env.cfg.train
        of_algorithm = {name: getattr(train.algorithm, name) for name in ("optimizer", "use_mixed_precision")}
        distillation = {name: value for name, value in vars(train.distillation).items() if name != "teacher"}
        student = network_settings(env.cfg)
        policy = self.teacher.policy
        return {
            **loop_settings(train.runner),
            "obs_groups": {"student": student["obs_groups"]["actor"], "teacher": list(policy.actor_observations)},
            "student": student["actor"],
            "teacher": actor_settings(policy),
            "algorithm": {
                "class_name": self.ALGORITHM,
                **distillation,
                **of_algorithm,
                "stock": train.runner.loop == "stock",
            },
        }

    def _networks(self) -> dict[str, Any]:
        return {"actor": self.alg.student, "teacher": self.alg.teacher}

    def _steps(self) -> Steps:
        return StudentRollout(self.env, self.alg)

    def _content(self, path: Path, infos: dict[str, Any] | None = None) -> dict[str, Any]:
        saved = super()._content(path, infos)
        saved["infos"]["teacher"] = dict(self.teacher.origin)
        saved["infos"]["networks"] = {**saved["infos"]["networks"], "teacher": dict(self.teacher.network)}
        return saved

    def _set_rate(self, saved: float) -> None:
        """Set the learning rate to that of `train.distillation`, which is constant. The `saved` one is not used."""
        self.alg.learning_rate = self.alg.optimizer.param_groups[0]["lr"] = self.env.cfg.train.distillation.learning_rate
