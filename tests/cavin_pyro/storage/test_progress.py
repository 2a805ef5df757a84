from __future__ import annotations

from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from cavin_pyro.storage.progress import ScalarLog


def test_scalars_are_on_disk_at_once_and_a_resumed_run_replaces_those_that_were_lost(tmp_path: Path) -> None:
    rows = [{"step": float(step), "validation_loss": 10.0 - step} for step in (2, 4, 6)]
    with ScalarLog(tmp_path) as log:
        log.add(rows[0])
        (path,) = tmp_path.iterdir()
        assert [event.step for event in EventFileLoader(str(path)).Load() if event.summary.value] == [2]
        log.add({"step": 4.0, "validation_loss": -1.0})  # of a validation that the resume file does not know
    with ScalarLog(tmp_path, rows[:2]) as log:
        log.add(rows[2])
    shown = EventAccumulator(str(tmp_path)).Reload()
    assert [(one.step, one.value) for one in shown.Scalars("validation_loss")] == [(2, 8.0), (4, 6.0), (6, 4.0)]
