"""Small robots as MJCF, without contacts and otherwise as varied as possible."""

import mujoco

_FREE_OF_CONTACT = '<default><geom contype="0" conaffinity="0" density="900"/></default>'


def robot(name, body, actuators="", *, option="", more=""):
    """:param more: elements beside the world and the actuators"""
    return f"""<mujoco model="{name}">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" {option}/>
  {_FREE_OF_CONTACT}
  <worldbody>{body}</worldbody>
  <actuator>{actuators}</actuator>
  {more}
</mujoco>"""


def chain(n, *, option="", actuator="motor", drives="", more="", **attributes):
    """An arm of ``n`` hinges that turn about z, y, y, x, y, x, ... with a site at its tip."""
    axes = ["0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0", "0 1 0"]
    opening, closing = "", ""
    for i in range(n):
        length = 0.35 - 0.03 * i if i < 8 else 0.12
        joint = {"damping": 0.1 * (i + 1), "armature": 0.01 * (1 + i % 3)} | attributes
        words = " ".join(f'{name}="{value}"' for name, value in joint.items())
        opening += f"""
        <body name="link{i}" pos="0 0 {0.3 if i == 0 else 0.35 - 0.03 * (i - 1)}">
          <joint name="j{i}" axis="{axes[i % 7]}" {words}/>
          <geom type="capsule" fromto="0.01 0 0 0.02 0.01 {length}" size="{0.05 - 0.004 * i}"/>"""
        closing += "</body>"
        drives += _drive(actuator, i)
    tip = '<site name="tip" pos="0.01 0 0.2" euler="0.1 0.2 0.3"/>'
    return robot(f"arm{n}", opening + tip + closing, drives, option=option, more=more)


def _drive(kind, i):
    return {
        "motor": f'<motor name="m{i}" joint="j{i}" gear="{10 - i}" ctrlrange="-1 1"/>',
        "position": f'<position name="m{i}" joint="j{i}" kp="{60 - 5 * i}" kv="{4 - 0.3 * i}" '
        f'ctrlrange="-2 2" forcerange="-{20 - 2 * i} {20 - 2 * i}"/>',
        "velocity": f'<velocity name="m{i}" joint="j{i}" kv="{6 - 0.4 * i}" ctrlrange="-1 1"/>',
        "none": "",
    }[kind]


CART_POLE = robot(
    "cart_pole",
    """<body name="cart" pos="0 0 1">
      <joint name="rail" type="slide" axis="1 0 0" damping="0.5"/>
      <geom type="box" size="0.1 0.05 0.05" mass="1"/>
      <body name="pole">
        <joint name="hinge" axis="0 1 0" damping="0.01" stiffness="0.3" springref="0.2"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.6" size="0.02" mass="0.2"/>
      </body>
    </body>""",
    '<motor name="push" joint="rail" gear="5" ctrlrange="-1 1" forcerange="-0.8 0.7"/>',
    option='integrator="RK4"',
)

GRIPPER = robot(
    "gripper",
    """<body name="wrist" pos="0 0 0.5">
      <joint name="lift" type="slide" axis="0 0 1" damping="5" stiffness="200" springref="0.05"/>
      <joint name="turn" axis="0 0 1" ref="0.3" damping="0.2" armature="0.01"/>
      <geom type="box" size="0.05 0.03 0.02" mass="0.6"/>
      <body name="left" pos="0.03 0 0.03">
        <joint name="left" type="slide" axis="1 0 0" damping="2" actuatorfrcrange="-6 5"/>
        <geom type="box" size="0.01 0.02 0.04" mass="0.1"/>
        <body name="pad" pos="0.01 0 0.05" euler="0 0.4 0">
          <geom type="box" size="0.005 0.01 0.02" mass="0.02"/>
        </body>
      </body>
      <body name="right" pos="-0.03 0 0.03" euler="0 0 3.141592653589793">
        <joint name="right" type="slide" axis="1 0 0" damping="2 3"/>
        <geom type="box" size="0.01 0.02 0.04" mass="0.1"/>
      </body>
    </body>""",
    """<position name="height" joint="lift" kp="800" dampratio="0.7" ctrlrange="-0.1 0.2"/>
    <dcmotor name="spin" joint="turn" motorconst="0.05" resistance="2" gear="30"
      cogging="0.002 7 0.4" ctrlrange="-12 12" armature="1e-5"/>
    <position name="left" joint="left" kp="400" kv="8" ctrlrange="-0.03 0.03"/>
    <general name="right" joint="right" gainprm="30 1 -2" gaintype="affine" biastype="affine"
      biasprm="0.5 -200 -3" ctrlrange="-1 1" forcerange="-5 5"/>""",
    option='integrator="implicitfast"',
)


def quadruped(base="", *, option="", actuator="position"):
    """Four legs of three hinges, on a trunk with these joints."""
    legs, drives = "", ""
    for name, x, y in (("FL", 1, 1), ("FR", 1, -1), ("RL", -1, 1), ("RR", -1, -1)):
        legs += f"""
        <body name="{name}_hip" pos="{0.2 * x} {0.05 * y} 0">
          <joint name="{name}_hip" axis="1 0 0" damping="0.1" armature="0.01"/>
          <geom type="sphere" size="0.04" pos="0.01 {0.01 * y} 0" mass="0.7"/>
          <body name="{name}_thigh" pos="0 {0.09 * y} 0">
            <joint name="{name}_thigh" axis="0 1 0" damping="0.1" armature="0.01"/>
            <geom type="capsule" fromto="0 0 0 -0.01 {0.01 * y} -0.2" size="0.02" mass="1"/>
            <body name="{name}_calf" pos="0 0 -0.21">
              <joint name="{name}_calf" axis="0 1 0" ref="-1.5" damping="0.1" armature="0.02"/>
              <geom type="capsule" fromto="0 0 0 0.01 0 -0.2" size="0.012" mass="0.2"/>
            </body>
          </body>
        </body>"""
        for part in ("hip", "thigh", "calf"):
            drives += {
                "position": f'<position name="{name}_{part}" joint="{name}_{part}" kp="20" '
                'kv="1.5" forcerange="-24 24"/>',
                "motor": f'<motor name="{name}_{part}" joint="{name}_{part}" ctrlrange="-9 9"/>',
            }[actuator]
    trunk = f"""<body name="trunk" pos="0 0 0.6">{base}
      <geom type="box" size="0.2 0.06 0.05" pos="0.01 0 0.005" mass="7"/>
      <site name="back" pos="-0.1 0 0.06"/>{legs}</body>"""
    return robot("quadruped", trunk, drives, option=option)


FREE_BASE = '<freejoint name="base"/>'

BALL = robot(
    "ball",
    """<body name="upper" pos="0 0 1" quat="0.9 0.1 -0.2 0.3" gravcomp="0.5">
      <joint name="shoulder" type="ball" damping="0.05" stiffness="0.6" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0.02 0 -0.3" size="0.03"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" damping="0.03"/>
        <geom type="capsule" fromto="0 0 0 0 0.01 -0.25" size="0.02"/>
      </body>
    </body>""",
    """<motor name="x" joint="shoulder" gear="1 0 0.5" ctrlrange="-1 1"/>
    <motor name="y" jointinparent="shoulder" gear="0.3 1 0" ctrlrange="-1 1"/>
    <position name="z" joint="shoulder" gear="0 0 1" kp="1" kv="0.2" ctrlrange="-1 1"/>
    <pid name="elbow" joint="elbow" kp="2" kv="0.1" input="pos vel ff"/>""",
    option='integrator="implicitfast"',
)

URDF = """<?xml version="1.0"?>
<robot name="two">
  <!-- Measured on Tuesday. -->
  <link name="base"/>
  <link name="upper"><inertial><mass value="1"/><origin xyz="0 0 0.2"/>
    <inertia ixx="0.01" iyy="0.02" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="lower"><inertial><mass value="0.5"/><origin xyz="0 0 0.1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="tool"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 1" rpy="1.57079632679 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-9" upper="9" effort="10" velocity="2"/>
    <dynamics damping="0.3" friction="0.2"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 0.4"/><axis xyz="0 1 0"/><dynamics damping="0.1" friction="0"/></joint>
  <joint name="flange" type="fixed"><parent link="lower"/><child link="tool"/>
    <origin xyz="0 0 0.2"/></joint>
</robot>
"""

_FINGER = '<limit lower="0" upper="0.04" effort="20" velocity="1"/>'
_FINGERS = "".join(
    f"""<link name="{side}_finger"><inertial><mass value="0.1"/><origin xyz="0 0.01 0.02"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="2e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="{side}_finger" type="prismatic"><parent link="tool"/><child link="{side}_finger"/>
    <origin xyz="0 0 0.05"/><axis xyz="0 {y} 0"/>{_FINGER}{more}</joint>"""
    for side, y, more in (
        ("left", 1, ""),
        ("right", 1, '<mimic joint="left_finger" multiplier="-2" offset="0.01"/>'),
    )
)
#: two hinges and two fingers, of which the right one follows the left one
GRIPPER_URDF = URDF.replace("</robot>", f"{_FINGERS}</robot>")


def compiled(xml, **options):
    """:param options: of the model: ``integrator``, ``timestep``"""
    spec = mujoco.MjSpec.from_string(xml)
    for name, value in options.items():
        setattr(spec.option, name, value)
    return spec.compile()
