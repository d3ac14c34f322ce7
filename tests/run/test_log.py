"""log.csv: empty cells, immediate rows, continuation."""

import math

import numpy as np
import pytest

from warp_lcp.run.log import Log

COLUMNS = ("step", "time", "speed", "status")


def test_rows_arrive_at_once_and_never_say_nan(tmp_path):
    log = Log(tmp_path / "log.csv", COLUMNS)
    log.append({"step": 1, "time": np.float64(0.1), "speed": None, "status": "A, B"})
    log.append({"step": 2, "time": 0.30000000000000004, "speed": math.nan, "status": None})
    log.append({"step": 3, "speed": True})
    assert (
        tmp_path / "log.csv"
    ).read_text() == 'step,time,speed,status\n1,0.1,,"A, B"\n2,0.30000000000000004,,\n3,,1,\n'
    log.close()


def test_unknown_columns_are_a_mistake(tmp_path):
    log = Log(tmp_path / "log.csv", COLUMNS)
    with pytest.raises(ValueError, match="mass"):
        log.append({"step": 1, "mass": 2.0})
    log.close()


def test_continuing_drops_later_and_broken_rows(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("step,time,speed,status\n1,0.1,,\n2,0.2,,\n3,0.3,,\n2,0.")
    log = Log(path, COLUMNS, after_step=2)
    log.append({"step": 3, "time": 0.25})
    log.close()
    assert path.read_text() == "step,time,speed,status\n1,0.1,,\n2,0.2,,\n3,0.25,,\n"


def test_other_columns_cannot_be_continued(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("step,time\n1,0.1\n")
    with pytest.raises(ValueError, match="its columns are 'step,time'"):
        Log(path, COLUMNS, after_step=1)
    assert path.read_text() == "step,time\n1,0.1\n"
