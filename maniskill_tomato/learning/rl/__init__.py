"""Reinforcement learning: DDPG and TD3, their training runs and their checkpoints."""
