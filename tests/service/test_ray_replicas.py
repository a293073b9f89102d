"""Replicas on PostgreSQL, S3 and a Ray cluster whose nodes share no folder; oracle: kissgs.compress of the scenes."""

import contextlib
import signal
import sys
from pathlib import Path

import pytest
from helpers.ray_cluster import kill_tree, tree
from helpers.ray_service import RayReplicas
from helpers.replica_kills import SETTINGS, kill_a_node, kill_a_replica, kill_at_random_moments
from helpers.running import is_alive, wait_until
from helpers.s3_server import CREDENTIALS
from helpers.service import SLOW, scene_bytes

import kissgs

MEDIUM = scene_bytes(6000, 2)
SECRETS = (b"X-Amz-Signature", CREDENTIALS["AWS_SECRET_ACCESS_KEY"].encode())


@pytest.fixture
def cluster(ray_cluster):
    """The cluster, with both nodes after the test."""
    yield ray_cluster
    ray_cluster.restore()


@pytest.fixture
def replicas(cluster, bucket, new_database, tmp_path):
    with RayReplicas(tmp_path / "data", cluster, bucket, new_database()) as it:
        yield it


def compressed(scene):
    return kissgs.compress(scene, settings=kissgs.Settings(preset="fast")).to_zip()


def content(path):
    with contextlib.suppress(OSError):
        return path.read_bytes()
    return b""


def test_nodes_need_no_folder_and_no_secret_is_seen(replicas, cluster):
    job = replicas.submit(scene_bytes(20_000, 3), SLOW)
    replicas.running(job)
    (process,) = replicas.children()
    folder = Path(f"/proc/{process}/cwd").readlink()
    assert folder.is_relative_to(cluster.folder)
    assert (folder / "scene.ply").exists()
    assert [path for replica in replicas.replicas for path in (replica.folder / "jobs").iterdir()] == []
    environment = content(Path(f"/proc/{process}/environ"))
    assert environment
    assert not any(line.startswith((b"AWS_", b"KISSGS_")) for line in environment.split(b"\0"))
    arguments = b"".join(content(path) for path in Path("/proc").glob("[0-9]*/cmdline"))
    assert not any(secret in arguments for secret in SECRETS)
    replicas.http.post(job["links"]["cancel"])
    assert not is_alive(process)
    assert replicas.leftovers() == []
    assert replicas.result(replicas.submit(MEDIUM)) == compressed(MEDIUM)
    assert replicas.leftovers() == []
    logs = [replica.log for replica in replicas.replicas] + [
        path for path in cluster.folder.rglob("*") if path.is_file()
    ]
    assert not any(secret in content(path) for path in logs for secret in SECRETS)


@pytest.mark.quick(0)
def test_a_job_whose_node_is_killed_runs_on_the_other_one(replicas, cluster):
    job = replicas.submit(MEDIUM)
    replicas.running(job)
    (process,) = replicas.children()
    kill_tree(next(node for node in cluster.nodes if process in tree(node.pid)))
    assert replicas.result(job) == compressed(MEDIUM)
    assert replicas.status(job)["starts"] == 2
    assert replicas.leftovers() == []


@pytest.mark.quick(0)
def test_a_replica_that_is_killed_takes_its_items_along(replicas):
    job = replicas.submit(scene_bytes(20_000, 3), SLOW)
    replicas.running(job)
    processes = replicas.children()
    replicas.kill(signal.SIGKILL)
    wait_until(lambda: not any(map(is_alive, processes)), seconds=30)
    wait_until(lambda: replicas.cluster.left_by_items() == [], seconds=30)
    replicas.restart()
    replicas.http.post(job["links"]["cancel"])
    assert replicas.result(replicas.submit(MEDIUM)) == compressed(MEDIUM)
    assert replicas.leftovers() == []


@pytest.mark.parametrize("kill", [kill_a_node, kill_a_replica])
@pytest.mark.quick(0)
def test_nodes_and_replicas_are_killed_at_random_moments(cluster, bucket, new_database, tmp_path, kill):
    it = RayReplicas(tmp_path / "kills", cluster, bucket, new_database(), **SETTINGS)
    found = kill_at_random_moments(it, kill, kills=10, jobs=4, seed=10)
    sys.stdout.write(f"starts of the jobs: {found.starts}\n")
    assert found.lost == found.different == 0
    assert found.leftovers == []
