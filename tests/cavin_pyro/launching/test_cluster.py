"""`launcher=ray`: a cluster of two nodes on this machine does what local processes do, also when it loses a node."""

from __future__ import annotations

import builtins
import itertools
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig

from cavin_pyro.config.errors import UserError
from cavin_pyro.data.collection import collect
from cavin_pyro.evaluation.evaluation import run_jobs
from cavin_pyro.launching.cluster import in_cluster
from cavin_pyro.launching.launcher import Launcher
from tests.cavin_pyro.conftest import contents
from tests.cavin_pyro.launching.work import act

pytestmark = pytest.mark.filterwarnings("ignore")  # Ray leaves files and processes to the garbage collector
NODE = {"num_cpus": 1, "object_store_memory": 80_000_000}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two nodes of one processor each, without Ray's dashboard."""
    pytest.importorskip("ray", reason="Ray is not installed: it comes with the extra ray")
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_agent_register_timeout_ms": "120000"}  # of a busy machine
    from ray.cluster_utils import Cluster

    two = Cluster(initialize_head=True, head_node_args={**NODE, "include_dashboard": False})
    two.add_node(**NODE)
    yield two
    two.shutdown()


@pytest.fixture
def ray(cluster: Any) -> Launcher:
    return Launcher("ray", address=cluster.address)


@pytest.fixture
def spare(cluster: Any) -> Any:
    """A third node, to be lost. This process is connected before it comes, so not through it."""
    import ray

    ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")
    return cluster.add_node(**NODE)


def test_every_job_is_done_once_and_in_order_if_asked(ray: Launcher) -> None:
    found = dict(ray.run(act, [("sleep", 0.1)] * 5))
    assert sorted(found) == [0, 1, 2, 3, 4]
    assert os.getpid() not in found.values()
    endless = (("sleep", 0.3 if number == 0 else 0.0) for number in itertools.count())
    handler = signal.getsignal(signal.SIGTERM)
    with closing(ray.run(act, endless, ordered=True)) as results:
        assert [next(results)[0] for _ in range(6)] == list(range(6))
        assert signal.getsignal(signal.SIGTERM) is handler


def test_a_bug_in_a_job_is_raised_as_it_is(ray: Launcher) -> None:
    with pytest.raises(ZeroDivisionError, match="^a bug$"):
        list(ray.run(act, [("fail", 0.0)]))


def test_a_job_whose_process_is_killed_is_run_again(ray: Launcher, tmp_path: Path) -> None:
    mark = tmp_path / "begun"
    assert dict(ray.run(_killed_once, [str(mark)])) == {0: "done"}
    assert mark.exists()


def _killed_once(mark: str) -> str:
    if not Path(mark).exists():
        Path(mark).touch()
        os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(60)
    return "done"


def test_collected_bytes_are_those_of_local_processes(ray: Launcher, pushes: Path, small: Any, tmp_path: Path) -> None:
    collect(small.pushes, tmp_path, transitions=60, workers=ray)
    ours, theirs = contents(tmp_path), contents(pushes)
    names = {"metadata.json", *(f"episodes-{number:05d}.h5" for number in range(3))}
    assert names <= set(ours)
    assert all(ours[name] == theirs[name] for name in names)


def test_a_job_that_was_running_on_a_lost_node_is_run_again_on_another(
    ray: Launcher, cluster: Any, spare: Any, tmp_path: Path
) -> None:
    """All processors are taken, so that some job waits on the node that is lost."""
    lost, found = spare, {}
    with closing(ray.run(_waiting_on_node, [(str(tmp_path), lost.node_id, number) for number in range(6)])) as results:
        for number, node in results:
            found[number] = node
            begun = tmp_path / "begun"
            for _ in range(600):
                if lost is None or begun.exists():
                    break
                time.sleep(0.1)
            if lost is not None:
                assert begun.exists()  # a job is on the node
                cluster.remove_node(lost, allow_graceful=False)
                name, lost = lost.node_id, None
    assert sorted(found) == list(range(6))
    assert name not in found.values()
    assert int((tmp_path / "begun").read_text()) in found


def _waiting_on_node(job: tuple[str, str, int]) -> str:
    """The node that this runs on; on the node to be lost, wait for that."""
    import ray

    folder, lost, number = job
    node = str(ray.get_runtime_context().get_node_id())
    if node == lost:
        (Path(folder) / "begun").write_text(str(number))
        time.sleep(600)
    time.sleep(1.0)  # so that one node does not do everything
    return node


@pytest.mark.parametrize("episodes", [8, pytest.param(40, marks=pytest.mark.soak)])
def test_episodes_are_those_of_this_process_also_when_a_node_is_lost(
    ray: Launcher, cluster: Any, spare: Any, configure: Callable[..., DictConfig], episodes: int
) -> None:
    config = configure("planner=random", f"episodes={episodes}")
    jobs = [(config, seed) for seed in range(episodes)]
    local = dict(run_jobs(jobs, 1))
    found, third = {}, spare
    with closing(run_jobs(jobs, ray)) as finished:
        for number, row in finished:
            found[number] = row
            if third is not None and len(found) > episodes // 10:
                cluster.remove_node(third, allow_graceful=False)
                third = None
    assert third is None
    assert sorted(found) == list(range(episodes))
    for number, row in found.items():
        assert {**row, "planning_ms": 0} == {**local[number], "planning_ms": 0}


@pytest.mark.soak
def test_five_thousand_transitions_lose_nothing_when_a_node_is_lost(
    ray: Launcher, cluster: Any, spare: Any, small: Any, tmp_path: Path
) -> None:
    """The bytes are those of local processes, which collect them first."""
    there, here = tmp_path / "ray", tmp_path / "local"
    there.mkdir(), here.mkdir()
    collect(small.pushes, here, transitions=5000, workers=2)

    def lose() -> None:
        while len(list(there.glob("episodes-*.h5"))) < 20:
            time.sleep(0.5)
        cluster.remove_node(spare, allow_graceful=False)

    losing = threading.Thread(target=lose)
    losing.start()
    collect(small.pushes, there, transitions=5000, workers=ray)
    losing.join(timeout=60)
    assert not losing.is_alive()
    expected, found = contents(here), contents(there)
    shards = {name for name in expected if name.endswith(".h5")} | {"metadata.json"}
    assert len(shards) > 200
    assert shards == {name for name in found if name.endswith(".h5")} | {"metadata.json"}
    assert all(found[name] == expected[name] for name in shards)


def test_no_cluster_at_an_address_is_one_line() -> None:
    pytest.importorskip("ray", reason="Ray is not installed: it comes with the extra ray")
    with pytest.raises(UserError, match="no Ray cluster at address=127.0.0.1:1 "):
        list(in_cluster(act, [("sleep", 0.0)], "127.0.0.1:1"))


def test_without_ray_one_line_tells_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    imported = builtins.__import__

    def without(name: str, *rest: Any, **more: Any) -> Any:
        if name == "ray":
            raise ImportError("no module named ray")
        return imported(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(UserError, match=r"launcher=ray needs Ray .*pip install -c constraints.txt '\.\[ray\]'"):
        list(Launcher("ray").run(act, [("sleep", 0.0)]))
