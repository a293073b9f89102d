"""``RayReplicas``: replicas whose jobs run on the nodes of a Ray cluster, and share nothing with them but a bucket."""

from __future__ import annotations

from pathlib import Path

from helpers.ray_cluster import NODE_MEMORY, RayCluster
from helpers.s3_server import Bucket
from helpers.service import Replicas


class RayReplicas(Replicas):
    """Two replicas and a cluster, of which each runs as many jobs at a time as the cluster has nodes of one processor.

    Nodes do not get the paths of data folders, and have temporary folders of their own.
    """

    def __init__(self, folder: Path, cluster: RayCluster, bucket: Bucket, database: str, **settings: object) -> None:
        self.cluster = cluster
        fixed = {
            "KISSGS_RUNNER": "ray",
            "KISSGS_RAY_ADDRESS": cluster.address,
            "KISSGS_JOB_MEMORY": NODE_MEMORY,
            "KISSGS_JOB_THREADS": 1,
        }
        super().__init__(folder, 2, bucket, database, **{**fixed, **settings})

    def children(self) -> list[int]:
        """Return the ids of the processes of all jobs; decoding, which stays on the replica, is not counted."""
        return self.cluster.items()

    def leftovers(self) -> list[str]:
        """Return the paths and keys of what no job should have left: here, on nodes, and in the bucket."""
        return [*super().leftovers(), *self.cluster.left_by_items()]
