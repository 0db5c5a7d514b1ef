"""Data sheets of the robots under resources/robots, to compare their models with: numbers of their public descriptions."""

from dataclasses import dataclass, field
from math import inf

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
    gains: tuple[float, float] | None = None
    """Stiffness and damping with which it was made to stand, where they are not its own."""
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
H1_LEG = "hip_yaw hip_roll hip_pitch knee ankle"
H1_ARM = "shoulder_pitch shoulder_roll shoulder_yaw elbow"

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
    "go2w": Facts(
        mass=19.523,
        centre=(-0.002648, 0.0, -0.090829),
        base_inertia=(0.0245024, 0.0982429, 0.1071627),
        joints=legs("FL FR RL RR", "{}_hip_joint {}_thigh_joint {}_calf_joint {}_wheel_joint"),
        effort={"hip": 23.7, "thigh": 23.7, "calf": 35.55, "wheel": 23.7},
        speed={"hip": 30.1, "thigh": 30.1, "calf": 20.07, "wheel": 30.1},
        ranges={
            "hip": (-1.0472, 1.0472),
            "FL_thigh": (-1.5708, 3.4907),
            "FR_thigh": (-1.5708, 3.4907),
            "RL_thigh": (-0.5236, 4.5379),
            "RR_thigh": (-0.5236, 4.5379),
            "wheel": (-inf, inf),
            "calf": (-2.7227, -0.83776),
        },
        feet=mirrored(
            {
                "FL_wheel": ((0.186454, 0.202, -0.321559), (0.1934, 0.202, -0.4394)),
                "RL_wheel": ((-0.200346, 0.202, -0.321559), (-0.1934, 0.202, -0.4394)),
            },
            {"FL_wheel": "FR_wheel", "RL_wheel": "RR_wheel"},
        ),
        armature={"hip": 0.01, "thigh": 0.01, "calf": 0.01, "wheel": 0.005},
        standing=0.396,
        gains=(70.0, 2.0),
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
    "go1": Facts(
        mass=12.743448,
        centre=(-0.003959, 0.000876, -0.018427),
        base_inertia=(0.0168128, 0.0630095, 0.0716547),
        joints=legs("FL FR RL RR", "{}_hip_joint {}_thigh_joint {}_calf_joint"),
        effort={"hip": 23.7, "thigh": 23.7, "calf": 35.55},
        speed={"hip": 30.1, "thigh": 30.1, "calf": 20.06},
        ranges={"hip": (-0.863, 0.863), "thigh": (-0.686, 4.501), "calf": (-2.818, -0.888)},
        feet=mirrored(
            {
                "FL_foot": ((0.172522, 0.157429, -0.301768), (0.1881, 0.12675, -0.426)),
                "RL_foot": ((-0.265216, 0.156501, -0.292514), (-0.1881, 0.12675, -0.426)),
            },
            {"FL_foot": "FR_foot", "RL_foot": "RR_foot"},
        ),
        armature={"hip": 0.004026312, "thigh": 0.004026312, "calf": 0.009059202},
        standing=0.281,
    ),
    "a1": Facts(
        mass=12.454,
        centre=(-0.008414, 0.000827, -0.018355),
        base_inertia=(0.0169399, 0.0566792, 0.0648138),
        joints=legs("FL FR RL RR", "{}_hip_joint {}_thigh_joint {}_calf_joint"),
        effort={"hip": 20.0, "thigh": 55.0, "calf": 55.0},
        speed={"hip": 52.4, "thigh": 28.6, "calf": 28.6},
        ranges={"hip": (-0.802851, 0.802851), "thigh": (-1.0472, 4.18879), "calf": (-2.69653, -0.916298)},
        feet=mirrored(
            {
                "FL_foot": ((0.168372, 0.160807, -0.282359), (0.183, 0.13205, -0.4)),
                "RL_foot": ((-0.255409, 0.159936, -0.273669), (-0.183, 0.13205, -0.4)),
            },
            {"FL_foot": "FR_foot", "RL_foot": "RR_foot"},
        ),
        armature={"joint": 0.01},
        standing=0.2651,
    ),
    "anymal_b": Facts(
        mass=30.621397,
        centre=(-0.001075, -0.000775, -0.030933),
        base_inertia=(0.2173911, 0.6394325, 0.6241408),
        joints=legs("LF RF LH RH", "{}_HAA {}_HFE {}_KFE"),
        effort={"HAA": 80.0, "HFE": 80.0, "KFE": 80.0},
        speed={"HAA": 15.0, "HFE": 20.0, "KFE": 20.0},
        ranges={"HAA": (-9.42, 9.42), "HFE": (-9.42, 9.42), "KFE": (-9.42, 9.42)},
        feet=mirrored(
            {
                "LF_FOOT": ((0.451298, 0.246, -0.4658), (0.4405, 0.246, -0.548)),
                "LH_FOOT": ((-0.451298, 0.246, -0.4658), (-0.4405, 0.246, -0.548)),
            },
            {"LF_FOOT": "RF_FOOT", "LH_FOOT": "RH_FOOT"},
        ),
        armature={},
        standing=0.4791,
        gains=(80.0, 2.0),
    ),
    "anymal_d": Facts(
        mass=57.02787,
        centre=(0.007455, -1.8e-05, -0.049393),
        base_inertia=(0.5320396, 1.8726713, 1.6997437),
        joints=legs("LF RF LH RH", "{}_HAA {}_HFE {}_KFE"),
        effort={"HAA": 80.0, "HFE": 80.0, "KFE": 80.0},
        speed={"HAA": 8.5, "HFE": 8.5, "KFE": 8.5},
        ranges={
            "L": (-0.785398, 0.610865),
            "R": (-0.610865, 0.785398),
            "HFE": (-9.424778, 9.424778),
            "KFE": (-9.424778, 9.424778),
        },
        feet=mirrored(
            {
                "LF_FOOT": ((0.495121, 0.309609, -0.557055), (0.473, 0.309609, -0.647077)),
                "LH_FOOT": ((-0.495121, 0.309609, -0.557055), (-0.473, 0.309609, -0.647077)),
            },
            {"LF_FOOT": "RF_FOOT", "LH_FOOT": "RH_FOOT"},
        ),
        armature={"HAA": 0.1, "HFE": 0.1, "KFE": 0.1},
        standing=0.5426,
        gains=(80.0, 2.0),
    ),
    "h1": Facts(
        mass=51.437,
        centre=(0.017723, 0.000972, -0.034371),
        base_inertia=(0.044582, 0.0082464, 0.049021),
        joints=(
            *legs("left right", " ".join("{}_" + name + "_joint" for name in H1_LEG.split())),
            "torso_joint",
            *legs("left right", " ".join("{}_" + name + "_joint" for name in H1_ARM.split())),
        ),
        effort={"hip": 200, "knee": 300, "ankle": 40, "torso": 200, "shoulder": 40, "shoulder_yaw": 18, "elbow": 18},
        speed={"hip": 23, "knee": 14, "ankle": 9, "torso": 23, "shoulder": 9, "shoulder_yaw": 20, "elbow": 20},
        ranges={
            "hip_yaw": (-0.43, 0.43),
            "hip_roll": (-0.43, 0.43),
            "hip_pitch": (-1.57, 1.57),
            "knee": (-0.26, 2.05),
            "ankle": (-0.87, 0.52),
            "torso": (-2.35, 2.35),
            "shoulder_pitch": (-2.87, 2.87),
            "left_shoulder_roll": (-0.34, 3.11),
            "right_shoulder_roll": (-3.11, 0.34),
            "left_shoulder_yaw": (-1.3, 4.45),
            "right_shoulder_yaw": (-4.45, 1.3),
            "elbow": (-1.25, 2.61),
        },
        feet=mirrored(
            {"left_foot": ((0.019934, 0.20286, -1.009228), (0.059468, 0.20286, -1.0192))}, {"left_foot": "right_foot"}
        ),
        foot_point=(0.02, 0.0, -0.045),
        armature={"hip": 0.1, "knee": 0.1, "ankle": 0.1, "torso": 0.1, "shoulder": 0.02, "elbow": 0.02},
        topples=1.81,
    ),
    "cassie": Facts(
        mass=33.312,
        centre=(-0.017367, 0.000107, -0.12863),
        base_inertia=(0.085821, 0.049222, 0.08626),
        joints=legs("left right", "{}_hip_roll {}_hip_yaw {}_hip_pitch {}_knee {}_foot"),
        effort={"hip_roll": 112.5, "hip_yaw": 112.5, "hip_pitch": 195.2, "knee": 195.2, "foot": 45.0},
        speed={"hip_roll": 12.15, "hip_yaw": 12.15, "hip_pitch": 8.51, "knee": 8.51, "foot": 11.52},
        ranges={
            "left_hip_roll": (-0.2618, 0.3927),
            "right_hip_roll": (-0.3927, 0.2618),
            "hip_yaw": (-0.3927, 0.3927),
            "hip_pitch": (-0.8727, 1.3963),
            "knee": (-2.8623, -0.6458),
            "foot": (-2.4435, -0.5236),
        },
        feet=mirrored(
            {"left_foot": ((0.000136, 0.1305, -0.987554), (0.019609, 0.1305, -1.121903))}, {"left_foot": "right_foot"}
        ),
        armature={"hip_roll": 0.038125, "hip_yaw": 0.038125, "hip_pitch": 0.09344, "knee": 0.09344, "foot": 0.01225},
        topples=1.0,
    ),
}
