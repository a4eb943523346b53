"""Fixtures and helpers that every test may use: pytest finds this module where the package is installed.

Tests on the real middleware take ``domain_id``: a ROS domain of their own for as long as they run, also when
several test runs share the machine. Tests with processes take ``processes``, which leaves none behind.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import pytest
from hypothesis import settings

from pendulum_testing.mcap_js_reader import McapJs, mcap_js_process
from pendulum_testing.rerun_reader import RerunMcap, find_rerun

if TYPE_CHECKING:
    from pendulum_bags.experiments.host_pool import HostPool
    from pendulum_testing.processes import ProcessGroup

__all__ = [
    "PROJECT",
    "domain_id",
    "hosts",
    "in_repository",
    "mcap_js",
    "own_domain",
    "processes",
    "rerun_mcap",
    "shared_data",
    "wait_for",
]

_MARK = Path("requirements", "run.in")
PROJECT = next(
    (folder for folder in (Path(__file__).resolve().parents[3], *Path.cwd().parents) if (folder / _MARK).is_file()),
    Path.cwd(),
)
"""The repository; where a package lies by itself, the folder of the tests."""
in_repository = pytest.mark.skipif(not (PROJECT / _MARK).is_file(), reason="reads files of the repository")
"""Marks a test that reads what lies beside the packages."""

# The same examples each time, so that a failure belongs to the change at hand; `--hypothesis-profile=explore` looks for
# new ones. No deadline: on a busy machine it measures the neighbours.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.register_profile("explore", max_examples=1000, deadline=None)
settings.load_profile("repeatable")

_T = TypeVar("_T")


def wait_for(predicate: Callable[[], _T], timeout: float, what: str, *, period: float = 0.02) -> _T:
    """Call ``predicate`` until it returns something true, and return that.

    Args:
        predicate: What to ask; an exception of it is not caught.
        timeout: Longest time to wait [s]; take ten times what you expect.
        what: What is waited for, as it should stand in the message.
        period: Time between two calls [s].

    Raises:
        AssertionError: When the time is over.
    """
    deadline = time.monotonic() + timeout
    while True:
        if value := predicate():
            return value
        if time.monotonic() > deadline:
            msg = f"waited {timeout:g} s for {what}; last answer was {value!r}"
            raise AssertionError(msg)
        time.sleep(period)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of recorded runs of real pendulums, which lies beside the repository.

    ``PENDULUM_SHARED_DATA`` names another place. They belong to their authors, so none of them is in the
    repository.
    """
    folder = Path(os.environ.get("PENDULUM_SHARED_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no recordings of real pendulums at {folder}; PENDULUM_SHARED_DATA names their folder")
    return folder


@pytest.fixture(scope="session")
def mcap_js() -> Iterator[McapJs]:
    """Offer the JavaScript readers of MCAP; tests skip where Node.js cannot be had."""
    with mcap_js_process() as readers:
        yield readers


@pytest.fixture(scope="session")
def rerun_mcap() -> RerunMcap:
    """Offer Rerun's reader of MCAP; tests skip where it cannot be had."""
    return find_rerun()


@contextlib.contextmanager
def own_domain(folder: Path) -> Iterator[int]:
    """Reserve a ROS domain on this machine and put it into the environment, for fixtures that several tests share.

    Args:
        folder: For the logs of ROS.
    """
    # Imported late: most tests know nothing of ROS. The recordings' package comes last, after those it depends on.
    reserve_domain = pytest.importorskip("pendulum_bags.experiments.domain").reserve_domain
    from rclpy.utilities import get_rmw_implementation_identifier

    from pendulum_msgs_py.ros.middleware import middleware_defaults

    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("ROS_DOMAIN_ID", raising=False)
        with reserve_domain() as domain:
            patch.setenv("ROS_DOMAIN_ID", str(domain))
            # Fast DDS reads its profile once in a process: tests that join the graph themselves do so as our programs
            # do.
            for name, value in middleware_defaults({}, get_rmw_implementation_identifier()).items():
                patch.setenv(name, value)
            patch.setenv("ROS_LOG_DIR", str(folder / "ros_log"))
            yield domain


@pytest.fixture
def domain_id(tmp_path: Path) -> Iterator[int]:
    """Reserve a ROS domain on this machine for this test, and put it into the environment."""
    with own_domain(tmp_path) as domain:
        yield domain


@pytest.fixture(scope="session")
def hosts() -> Iterator[HostPool]:
    """Keep the processes in which programs of tests run, one after the other: to start one takes half a second."""
    with pytest.importorskip("pendulum_bags.experiments.host_pool").HostPool() as pool:
        yield pool


@pytest.fixture
def processes(tmp_path: Path, hosts: HostPool) -> Iterator[ProcessGroup]:
    """Start programs of the project, which end with the test; one that has to be killed then fails it.

    They run in hosts, as those of studies do: a test that looks at how a program starts or ends starts it ``alone``.
    """
    from pendulum_testing.processes import ProcessGroup

    group = ProcessGroup(tmp_path / "processes", PROJECT, hosts)
    yield group
    if leftovers := group.close():
        pytest.fail("processes that did not end by themselves: " + "; ".join(leftovers))
