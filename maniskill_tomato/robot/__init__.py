"""The arm and its camera: numbers, kinematics, the ManiSkill agent."""
