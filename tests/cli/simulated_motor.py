"""A joint with a motor of known numbers, simulated finely by formulas of its own: what a log of a test bench would hold."""

import numpy as np

TRUTH = {
    "stiffness": 60.0,
    "damping": 1.5,
    "stall_torque": 45.0,
    "no_load_speed": 12.0,
    "coulomb": 1.2,
    "breakaway": 2.0,
    "stribeck_velocity": 0.3,
    "viscous": 0.25,
    "delay": 0.0075,
}


def simulated_log(
    seconds: float = 40.0, dt: float = 0.0025, joints: int = 2, noise: float = 0.0, seed: int = 0, **truth: float
) -> dict:
    """The arrays of a log: arms of 0.15 kg m^2 under gravity, which follow sweeps and jumps of the target."""
    rng = np.random.default_rng(seed)
    t = TRUTH | truth
    steps, fine = round(seconds / dt), 10
    hold = round(0.01 / dt)  # targets come every 10 ms
    time = dt * np.arange(steps)
    arrays = {name: np.zeros((steps, joints)) for name in ("target", "position", "velocity", "torque")}
    for j in range(joints):
        phase = np.cumsum(2.0 * np.pi * dt * (0.2 + 3.0 * (0.5 + 0.5 * np.sin(0.35 * time + j))))
        jumps = np.repeat(rng.uniform(-1.0, 1.0, steps // 160 + 1), 160)[:steps]
        target = 0.5 * np.sin(phase) + np.where(time % 8.0 < 5.0, 1.0, 0.0) * jumps
        arrays["target"][:, j] = np.repeat(target[::hold], hold)[:steps]
        q = v = 0.0
        late = round(t["delay"] / dt)
        for k in range(steps):
            wanted = arrays["target"][max(k - late, 0), j]
            for i in range(fine):
                asked = t["stiffness"] * (wanted - q) - t["damping"] * v
                high = t["stall_torque"] * (1.0 - v / t["no_load_speed"])
                low = -t["stall_torque"] * (1.0 + v / t["no_load_speed"])
                dry = t["coulomb"] + (t["breakaway"] - t["coulomb"]) * np.exp(-((v / t["stribeck_velocity"]) ** 2))
                torque = min(max(asked, low), high) - dry * np.tanh(v / 0.1) - t["viscous"] * v
                if i == 0:
                    for name, value in (("position", q), ("velocity", v), ("torque", torque)):
                        arrays[name][k, j] = value
                v += dt / fine * (torque - 3.0 * np.sin(q)) / 0.15
                q += dt / fine * v
    arrays["torque"] += noise * rng.standard_normal(arrays["torque"].shape)
    arrays["velocity"] += 0.02 * noise * rng.standard_normal(arrays["torque"].shape)
    names = np.array([f"joint_{j}" for j in range(joints)])
    return {**arrays, "dt": np.array(dt), "joint_names": names, "stiffness": np.array(60.0), "damping": np.array(1.5)}
