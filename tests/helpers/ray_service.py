"""``RayService``: a service whose jobs run on the nodes of a Ray cluster."""

from __future__ import annotations

from pathlib import Path

from helpers.ray_cluster import NODE_MEMORY, RayCluster
from helpers.service import ServiceProcess


class RayService(ServiceProcess):
    """A service and a cluster of nodes with one processor each, which see no data folder but those that are shared."""

    workers = 2

    def __init__(self, folder: Path, cluster: RayCluster, **settings: object) -> None:
        self.cluster = cluster
        fixed = {
            "KISSGS_RUNNER": cluster.address,
            "KISSGS_WORKERS": self.workers,
            "KISSGS_JOB_MEMORY": NODE_MEMORY,
            "KISSGS_JOB_THREADS": 1,
        }
        super().__init__(folder, **{**fixed, **settings})

    def children(self) -> list[int]:
        """Return the ids of the processes of all jobs; decoding, which stays with the service, is not counted."""
        return self.cluster.items()

    def leftovers(self) -> list[str]:
        """Return the paths of what no job should have left, in the data folder and on nodes."""
        return [*super().leftovers(), *self.cluster.left_by_items()]
