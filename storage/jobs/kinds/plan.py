"""Plans: one shard searches grips with a model version; all else is as for a rollout."""

from physworld_storage.jobs.kinds.rollout import RunJobs

KIND = RunJobs("plan", "iterations")
