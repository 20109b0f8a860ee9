"""A KUKA LBR iiwa with a wrist camera as a robot of LeRobot: `--robot.type=kuka_iiwa`."""

from lerobot_robot_kuka_iiwa.config_kuka_iiwa import KukaIiwaConfig
from lerobot_robot_kuka_iiwa.kuka_iiwa import KukaIiwa

__all__ = ["KukaIiwa", "KukaIiwaConfig"]
