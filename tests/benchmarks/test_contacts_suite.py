"""Suite of rigid contacts with few scenes and sweeps.

It measures every method, and its comparison follows from the residuals.
"""

import pytest

from warp_lcp.benchmarks import contact_steps, contacts
from warp_lcp.benchmarks.harness.timing import Options


@pytest.fixture
def small(monkeypatch):
    for name, value in (
        ("SWEEPS", 60),
        ("EQUAL", (5, 60)),
        ("RATIOS", (1.0, 100.0)),
        ("STACKS", ("sphere-stack",)),
        ("DRAWN", ("incline",)),
    ):
        monkeypatch.setattr(contacts, name, value)
    for name, value in (("SPHERES", 30), ("SIDE", 4), ("SETTLING", 8), ("STEPS", 2)):
        monkeypatch.setattr(contact_steps, name, value)
    kept = {name: contacts.SCENES[name] for name in ("sphere-stack", "incline")}
    monkeypatch.setattr(contacts, "SCENES", kept)


def test_the_suite_measures_every_method_on_every_scene(small, tmp_path):
    results = contacts.measure(Options("cpu", (), 1, lambda text: None), tmp_path)
    by_name = {record.name: record for record in results.records}
    for scene in ("sphere-stack", "incline"):
        for method in (*contacts.BOXED, *contacts.LCP):
            record = by_name[f"{scene}: {method}"]
            assert 0 <= record.value("residual") < 1
            assert record.value("seconds") > 0
    assert by_name["incline: Lemke"].facts["status"] == "CONVERGED"
    pgs, nncg = (by_name["equal sweeps: sphere-stack"].value(f"{m}_60") for m in ("PGS", "NNCG"))
    assert by_name["equal sweeps: sphere-stack"].value("ratio_60") == pytest.approx(pgs / nncg)
    assert pgs / nncg > 10
    assert [table.title for table in results.tables][2:-1] == ["sphere-stack", "incline"]
    for method in contact_steps.METHODS:
        step = by_name[f"30 spheres in a box: {method}"]
        assert step.value("seconds") > step.value("solve_seconds") > 0
        assert step.value("residual") <= contact_steps.TOLERANCE
    assert len(results.charts) == 1
