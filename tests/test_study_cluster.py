"""A study on a real Dask cluster, one of whose workers is killed midway."""

import os
import signal
import threading
from pathlib import Path

import distributed
import pytest
from study_worlds import small_study
from test_study import assert_whole, until

from recon.cli import main
from recon.study.run import run_study


def test_no_cell_is_lost_with_a_worker(tmp_path: Path) -> None:
    lines = tmp_path / "out" / "cells.jsonl"
    killed = []

    def kill_one(cluster) -> None:
        """Once the first job is back, end a worker that is at another."""
        until(lambda: lines.exists() and lines.stat().st_size > 0)
        state = cluster.scheduler.workers
        until(lambda: any(worker.processing for worker in state.values()))
        busy = next(worker.name for worker in list(state.values()) if worker.processing)
        process = cluster.workers[busy].process
        killed.append(process.pid)
        os.kill(process.pid, signal.SIGKILL)

    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        killer = threading.Thread(target=kill_one, args=(cluster,))
        killer.start()
        summary = run_study(small_study(tmp_path), tmp_path / "out", scheduler=cluster.scheduler_address)
        killer.join()
    assert len(killed) == 1
    assert summary["failed"] == 0
    assert_whole(tmp_path / "out")


def test_a_scheduler_that_does_not_answer(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    arguments = ["-o", str(tmp_path / "out"), "--scheduler", "tcp://127.0.0.1:9"]
    assert main(["blur-study", str(small_study(tmp_path)), *arguments]) == 2
    assert "no Dask scheduler answers at tcp://127.0.0.1:9" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
