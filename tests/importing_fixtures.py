"""Robots by hand, for tests of what is read from URDF and MJCF files."""

LEGS = {"fl": (0.2, 0.1), "fr": (0.2, -0.1), "hl": (-0.2, 0.1), "hr": (-0.2, -0.1)}

URDF_LEG = """
<joint name="{n}_hip" type="revolute"><parent link="trunk"/><child link="{n}_hip"/><origin xyz="{x} {y} 0"/>
 <axis xyz="1 0 0"/><limit lower="-0.8" upper="0.8" effort="30" velocity="20"/></joint>
<link name="{n}_hip"><inertial><mass value="0.5"/><inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/>
 </inertial></link>
<joint name="{n}_thigh" type="revolute"><parent link="{n}_hip"/><child link="{n}_thigh"/><origin xyz="0 {side} 0"/>
 <axis xyz="0 1 0"/><limit lower="-1.5" upper="3" effort="30" velocity="20"/></joint>
<link name="{n}_thigh"><inertial><origin xyz="0 0 -0.1"/><mass value="1"/>
 <inertia ixx="0.005" iyy="0.005" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
 <collision><origin xyz="0 0 -0.1"/><geometry><cylinder radius="0.02" length="0.2"/></geometry></collision></link>
<joint name="{n}_calf" type="revolute"><parent link="{n}_thigh"/><child link="{n}_calf"/><origin xyz="0 0 -0.2"/>
 <axis xyz="0 1 0"/><limit lower="-2.7" upper="-0.5" effort="30" velocity="20"/></joint>
<link name="{n}_calf"><inertial><origin xyz="0 0 -0.1"/><mass value="0.2"/>
 <inertia ixx="0.001" iyy="0.001" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial>
 <collision><origin xyz="0 0 -0.09"/><geometry><cylinder radius="0.01" length="0.16"/></geometry></collision></link>
<joint name="{n}_foot_fixed" type="fixed" dont_collapse="true"><parent link="{n}_calf"/><child link="{n}_foot"/>
 <origin xyz="0 0 -0.2"/></joint>
<link name="{n}_foot"><inertial><mass value="0.05"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/>
 </inertial><collision><geometry><sphere radius="0.02"/></geometry></collision></link>
"""
"""A leg of 1.75 kg: hip 0.5, thigh 1, calf 0.2, foot 0.05."""
LEG_MASS = 1.75
TRUNK = """
<link name="trunk"><inertial><mass value="6"/><inertia ixx="0.03" iyy="0.08" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
 <collision><geometry><box size="0.5 0.16 0.1"/></geometry></collision></link>
"""


def urdf(extra: str = "", trunk: str = TRUNK, legs: str = "") -> str:
    """A URDF of a quadruped of 13 kg, with `extra` elements, another `trunk`, or other `legs`."""
    own = "".join(URDF_LEG.format(n=n, x=x, y=y, side=0.05 if y > 0 else -0.05) for n, (x, y) in LEGS.items())
    return f'<?xml version="1.0"?>\n<robot name="toy">{trunk}{legs or own}{extra}</robot>'
