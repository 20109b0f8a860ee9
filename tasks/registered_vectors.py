"""What `gymnasium.make_vec` makes of the four ids, by the names in their specifications."""

from functools import partial

from maniskill_tomato.tasks import TASK_IDS
from maniskill_tomato.tasks.vector_env import make_vector_env

make_guided, make_sparse, make_general, make_row = (partial(make_vector_env, env_id) for env_id in TASK_IDS)
