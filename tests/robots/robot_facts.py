"""Data sheets of the robots under resources/robots, to compare their models with: numbers of their public descriptions."""

from dataclasses import dataclass, field

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Facts:
    """One robot's. Units are SI; points are in the base frame."""

    mass: float
    centre: Point
    """Centre of mass in the default pose."""
    base_inertia: Point
    """Ixx, Iyy, Izz of the base with what is fixed to it, about its centre of mass, in its frame."""
    joints: tuple[str, ...]
    """In the order of the model."""
    effort: dict[str, float]
    """By the part of a joint's name."""
    speed: dict[str, float]
    ranges: dict[str, tuple[float, float]]
    feet: dict[str, tuple[Point, Point]]
    """Foot -> its centre in the default pose, and at zero angles."""
    foot_point: Point | None = None
    """The point of a foot's body that is meant, where it is not the centre of its shape."""
    armature: dict[str, float] = field(default_factory=dict)
    standing: float | None = None
    """Base height after 2 s under the robot's own gains, started with its feet just touching, elliptic cone, impratio 100;
    none for a robot that topples."""
    topples: float | None = None
    """Or when it leans by 30 degrees then [s]."""


def legs(names: str, joints: str) -> tuple[str, ...]:
    """Every joint of every leg; the joints' names have a place for the leg's."""
    return tuple(joint.format(leg) for leg in names.split() for joint in joints.split())


def mirrored(left: dict[str, tuple[Point, Point]], right: dict[str, str]) -> dict[str, tuple[Point, Point]]:
    """Those feet and their images at the other side."""
    images = {right[name]: tuple((x, -y, z) for x, y, z in points) for name, points in left.items()}
    return {**left, **images}  # type: ignore[dict-item]


G1_LEG = "hip_pitch hip_roll hip_yaw knee ankle_pitch ankle_roll"
G1_ARM = "shoulder_pitch shoulder_roll shoulder_yaw elbow wrist_roll wrist_pitch wrist_yaw"
G1_ARM_EFFORT = {"shoulder": 25.0, "elbow": 25.0, "wrist_roll": 25.0, "wrist_pitch": 5.0, "wrist_yaw": 5.0}

FACTS = {
    "go2": Facts(
        mass=15.019,
        centre=(-0.00323, 0.0, -0.017369),
        base_inertia=(0.0245024, 0.0982429, 0.1071627),
        joints=legs("FL FR RL RR", "{}_hip_joint {}_thigh_joint {}_calf_joint"),
        effort={"hip": 23.7, "thigh": 23.7, "calf": 35.55},
        speed={"hip": 30.1, "thigh": 30.1, "calf": 20.07},
        ranges={
            "hip": (-1.0472, 1.0472),
            "FL_thigh": (-1.5708, 3.4907),
            "FR_thigh": (-1.5708, 3.4907),
            "RL_thigh": (-0.5236, 4.5379),
            "RR_thigh": (-0.5236, 4.5379),
            "calf": (-2.7227, -0.83776),
        },
        feet=mirrored(
            {
                "FL_foot": ((0.176292, 0.172731, -0.301503), (0.1914, 0.142, -0.426)),
                "RL_foot": ((-0.272271, 0.171769, -0.291921), (-0.1954, 0.142, -0.426)),
            },
            {"FL_foot": "FR_foot", "RL_foot": "RR_foot"},
        ),
        armature={"joint": 0.01},
        standing=0.273,
    ),
    "g1": Facts(
        mass=33.341142,
        centre=(0.030594, 8.2e-05, -0.087591),
        base_inertia=(0.010549, 0.0093089, 0.0079184),
        joints=(
            *legs("left right", " ".join("{}_" + name + "_joint" for name in G1_LEG.split())),
            *legs("waist", "{}_yaw_joint {}_roll_joint {}_pitch_joint"),
            *legs("left right", " ".join("{}_" + name + "_joint" for name in G1_ARM.split())),
        ),
        effort=G1_ARM_EFFORT
        | {"hip_pitch": 88, "hip_yaw": 88, "hip_roll": 139, "knee": 139, "ankle": 50, "waist_yaw": 88}
        | {"waist_roll": 50, "waist_pitch": 50},
        speed={"hip_pitch": 32, "hip_yaw": 32, "hip_roll": 20, "knee": 20, "ankle": 37, "waist_yaw": 32, "waist_roll": 37}
        | {"waist_pitch": 37, "shoulder": 37, "elbow": 37, "wrist_roll": 37, "wrist_pitch": 22, "wrist_yaw": 22},
        ranges={
            "hip_pitch": (-2.5307, 2.8798),
            "left_hip_roll": (-0.5236, 2.9671),
            "right_hip_roll": (-2.9671, 0.5236),
            "hip_yaw": (-2.7576, 2.7576),
            "knee": (-0.087267, 2.8798),
            "ankle_pitch": (-0.87267, 0.5236),
            "ankle_roll": (-0.2618, 0.2618),
            "waist_yaw": (-2.618, 2.618),
            "waist_roll": (-0.52, 0.52),
            "waist_pitch": (-0.52, 0.52),
            "shoulder_pitch": (-3.0892, 2.6704),
            "left_shoulder_roll": (-1.5882, 2.2515),
            "right_shoulder_roll": (-2.2515, 1.5882),
            "shoulder_yaw": (-2.618, 2.618),
            "elbow": (-1.0472, 2.0944),
            "wrist_roll": (-1.97222, 1.97222),
            "wrist_pitch": (-1.61443, 1.61443),
            "wrist_yaw": (-1.61443, 1.61443),
        },
        feet=mirrored(
            {"left_foot": ((0.038804, 0.118506, -0.758457), (0.039998, 0.118506, -0.793864))}, {"left_foot": "right_foot"}
        ),
        foot_point=(0.04, 0.0, -0.037),
        armature={"hip_pitch": 0.01017752, "hip_yaw": 0.01017752, "hip_roll": 0.025101925, "knee": 0.025101925}
        | {"ankle": 0.00721945, "waist_yaw": 0.01017752, "waist_roll": 0.00721945, "waist_pitch": 0.00721945}
        | {"shoulder": 0.003609725, "elbow": 0.003609725, "wrist_roll": 0.003609725}
        | {"wrist_pitch": 0.00425, "wrist_yaw": 0.00425},
        topples=1.165,
    ),
    "spot": Facts(
        mass=50.34,
        centre=(-0.018784, -6.3e-05, -0.019408),
        base_inertia=(0.1796, 2.0485, 2.0880),  # a box's, m / 12 (a² + b²)
        joints=legs("fl fr hl hr", "{}_hx {}_hy {}_kn"),
        effort={"hx": 45.0, "hy": 45.0, "kn": 113.0},
        speed={"hx": 20.0, "hy": 20.0, "kn": 20.0},
        ranges={"hx": (-0.785398, 0.785398), "hy": (-0.898845, 2.24363), "kn": (-2.7929, -0.255648)},
        feet=mirrored(
            {
                "fl_foot": ((0.252728, 0.214786, -0.482683), (0.32285, 0.1658, -0.6565)),
                "hl_foot": ((-0.440657, 0.212904, -0.463922), (-0.27285, 0.1658, -0.6565)),
            },
            {"fl_foot": "fr_foot", "hl_foot": "hr_foot"},
        ),
        armature={"hx": 0.05, "hy": 0.05, "kn": 0.05},
        standing=0.473,
    ),
}
