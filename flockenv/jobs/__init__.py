"""Jobs: long work as independent pieces with keys, run by one machine or a cluster, with stored results."""

from flockenv.jobs.engine import ENGINES, Engine, engine_of
from flockenv.jobs.job import Failure, Job
from flockenv.jobs.run import FailedJobsError, Shard, ShardDone, Work, run_jobs
from flockenv.jobs.store import Store

__all__ = [
    "ENGINES", "Engine", "FailedJobsError", "Failure", "Job", "Shard", "ShardDone", "Store", "Work", "engine_of",
    "run_jobs",
]  # fmt: skip
