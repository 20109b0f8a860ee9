"""Turns the last joint of the twin by 0.05 rad through LeRobot.

lerobot-env/bin/python integrations/lerobot/turn_a_joint.py
"""

from lerobot.robots import RobotConfig, make_robot_from_config
from lerobot.utils.import_utils import register_third_party_plugins

if __name__ == "__main__":
    register_third_party_plugins()
    config = RobotConfig.get_choice_class("kuka_iiwa")(profile="mock")
    with make_robot_from_config(config) as robot:
        seen = robot.get_observation()
        joints = {name: seen[name] for name in robot.action_features}
        sent = robot.send_action({**joints, "joint_7.pos": joints["joint_7.pos"] + 0.05})
        print({name: round(value, 4) for name, value in sent.items()})
