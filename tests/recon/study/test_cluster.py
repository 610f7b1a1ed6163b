"""A study on a Dask cluster, one of whose workers is killed while it runs."""

import os
import signal
import threading
from pathlib import Path

import distributed
import pytest

from recon.cli import main
from recon.study.run import run_study
from tests.support.study import assert_study_is_complete, small_study, wait_until


@pytest.mark.slow
def test_cells_of_a_killed_worker_are_computed_by_another(tmp_path: Path) -> None:
    lines = tmp_path / "out" / "cells.jsonl"
    killed_pids = []

    def kill_one(cluster) -> None:
        """When the first job is finished, kill a worker that is processing another."""
        wait_until(lambda: lines.exists() and lines.stat().st_size > 0)
        state = cluster.scheduler.workers
        wait_until(lambda: any(worker.processing for worker in state.values()))
        busy = next(worker.name for worker in list(state.values()) if worker.processing)
        process = cluster.workers[busy].process
        killed_pids.append(process.pid)
        os.kill(process.pid, signal.SIGKILL)

    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        killer = threading.Thread(target=kill_one, args=(cluster,))
        killer.start()
        summary = run_study(small_study(tmp_path), tmp_path / "out", scheduler=cluster.scheduler_address)
        killer.join()
    assert len(killed_pids) == 1
    assert summary["failed"] == 0
    assert_study_is_complete(tmp_path / "out")


@pytest.mark.slow
def test_a_scheduler_that_does_not_answer_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    arguments = ["-o", str(tmp_path / "out"), "--scheduler", "tcp://127.0.0.1:9"]
    assert main(["blur-study", str(small_study(tmp_path)), *arguments]) == 2
    assert "no Dask scheduler answers at tcp://127.0.0.1:9" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
