"""Names of the queues. The API never publishes: the dispatcher reads the database and does."""

from __future__ import annotations

SIMULATION = "sim"
TRAINING = "train"
INFERENCE = "infer"
TASK_NAME = "physworld.run_shard"
