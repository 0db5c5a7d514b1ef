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
    armature: dict[str, float] = field(default_factory=dict)
    standing: float | None = None
    """Base height after 2 s under the robot's own gains, started with its feet just touching, elliptic cone, impratio 100."""


def legs(names: str, joints: str) -> tuple[str, ...]:
    """Every joint of every leg; the joints' names have a place for the leg's."""
    return tuple(joint.format(leg) for leg in names.split() for joint in joints.split())


def mirrored(left: dict[str, tuple[Point, Point]], right: dict[str, str]) -> dict[str, tuple[Point, Point]]:
    """Those feet and their images at the other side."""
    images = {right[name]: tuple((x, -y, z) for x, y, z in points) for name, points in left.items()}
    return {**left, **images}  # type: ignore[dict-item]


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
}
