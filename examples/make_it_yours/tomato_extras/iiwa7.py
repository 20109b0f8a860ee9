"""Another arm than the iiwa 14: the KUKA LBR iiwa 7 R800, as its drivers would declare it.

The package registers the model by an entry point (`pyproject.toml`), so that the twin can move it in MuJoCo:

    pip install ./examples/make_it_yours
    maniskill-tomato deploy run --profile examples/make_it_yours/iiwa7_twin.toml --seed 3 --out runs/iiwa7

A driver for the real arm is a subclass of `maniskill_tomato.deploy.interface.Arm` with `model = MODEL`.
"""

from pathlib import Path
from typing import Final

from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.arm_urdf import read_arm_model

MODEL: Final[ArmModel] = read_arm_model(
    Path(__file__).parent / "iiwa7.urdf",
    name="iiwa7",
    flange_link="link_ee",
    # KUKA's data sheet has none. These are those of the iiwa 14, the heavier arm.
    acceleration_limits=(8.57, 8.57, 8.74, 11.36, 12.23, 15.72, 15.72),
    spheres={
        "link_5": (
            (0.0, 0.0, 0.012, 0.0689),
            (0.0, -0.0036, 0.045, 0.0688),
            (0.0, -0.0144, 0.075, 0.0664),
            (0.0, -0.0288, 0.103, 0.0639),
            (0.0, -0.045, 0.13, 0.0631),
            (0.0, -0.063, 0.157, 0.0661),
            (0.0, -0.0684, 0.183, 0.07),
            (0.0, -0.0702, 0.205, 0.0701),
        ),
        "link_6": (
            (0.0, 0.0198, 0.0, 0.0672),
            (0.0, 0.045, 0.0, 0.066),
            (0.0, 0.0702, 0.0, 0.0686),
            (0.0, 0.054, 0.035, 0.076),
            (0.0, 0.072, 0.03, 0.0759),
        ),
        "link_7": ((0.0, 0.0, 0.012, 0.0514),),
        "link_ee": ((0.0, 0.0, 0.008, 0.038),),
    },
    ready_qpos=(0.0, -0.894598, 0.0, -1.691162, 0.0, 0.774233, 0.0),
)
"""In its ready posture the flange is at (0.1, 0, 0.87) m and looks along +x."""
