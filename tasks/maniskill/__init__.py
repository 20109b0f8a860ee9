"""The ManiSkill side of the tasks: robot agent, controllers, actors, scene."""
