"""Values of settings, drawn from their annotations, and the rules by hand.

New methods are covered automatically.
"""

import dataclasses
import inspect
import math
import pickle
import re
import subprocess
import sys
from typing import Annotated, Literal, Union, get_args, get_origin

import numpy as np
import pytest
from annotated_types import Ge, Gt, Le, Lt
from hypothesis import given
from hypothesis import strategies as st

import warp_lcp as wl
from warp_lcp.contacts.inverse_kinematics import InverseKinematics
from warp_lcp.gallery.planted import PlantedSolution
from warp_lcp.granular.stress_methods import METHODS as SAND
from warp_lcp.grid import staggered
from warp_lcp.material import density_correction
from warp_lcp.multigrid.cycle_settings import AlgebraicSettings
from warp_lcp.settings import (
    OrInfinite,
    SettingError,
    Settings,
    checked,
    ranges,
    renamed_method,
    rule,
)

KINDS = [
    *wl.METHODS.values(),
    wl.StoppingCriteria,
    wl.CycleSettings,
    AlgebraicSettings,
    InverseKinematics,
    PlantedSolution,
]
KINDS = [kind for kind in [*KINDS, *SAND.values()] if dataclasses.fields(kind)]
# Values that are no numbers.
NUMBERS = [
    None,
    True,
    "1",
    [1.0],
    1j,
    math.nan,
    -math.inf,
    np.float64("nan"),
    np.bool_(True),
    np.ones(2),
]


def ranged(annotation):
    """Return the range of a number, also within alternatives; None if there is none."""
    parts = (
        [annotation]
        if get_origin(annotation) is Annotated
        else get_args(annotation)
        if get_origin(annotation) is Union
        else []
    )
    return next(
        (
            part
            for part in parts
            if get_origin(part) is Annotated and get_args(part)[0] in (int, float)
        ),
        None,
    )


SETTINGS = [(kind, name, annotation) for kind in KINDS for name, annotation in ranges(kind).items()]
RANGED = [(kind, name, annotation) for kind, name, annotation in SETTINGS if ranged(annotation)]


def limits(annotation):
    kind, *found = get_args(ranged(annotation))
    return kind, found


def beyond(annotation):
    """Return numbers outside a range.

    Beyond each of its ends, and open ends themselves.
    """
    kind, found = limits(annotation)
    for limit in found:
        match limit:
            case Gt(gt=end):
                yield from (end, end - 1, math.nextafter(end, -math.inf))
            case Ge(ge=end):
                yield from (end - 1, *([] if kind is int else [math.nextafter(end, -math.inf)]))
            case Lt(lt=end):
                yield from (end, end + 1)
            case Le(le=end):
                yield from (end + 1, math.nextafter(end, math.inf))
    if kind is int:
        yield from (1.5, math.inf)
    elif OrInfinite not in found:
        yield math.inf


def test_settings_of_every_method_are_checked():
    """Checked settings of every method.

    A method whose class is no `Settings`, or a number without a range, would accept anything.
    """
    assert all(issubclass(kind, Settings) and kind() == kind() for kind in KINDS)
    assert not [
        (kind.__name__, name)
        for kind, name, annotation in SETTINGS
        if annotation in (int, float, str) and name != "prefix"
    ]
    assert len(RANGED) > 60


@pytest.mark.every_case
@pytest.mark.parametrize(
    ("kind", "name", "annotation"),
    RANGED,
    ids=lambda v: getattr(v, "__name__", v if isinstance(v, str) else "_"),
)
def test_numbers_outside_their_range_are_named(kind, name, annotation):
    wrong = [
        value
        for value in (*NUMBERS, *beyond(annotation))
        if value is not None or type(None) not in get_args(annotation)
    ]
    for value in [
        v for v in wrong if name != "blocks" or not isinstance(v, (str, list, np.ndarray))
    ]:
        with pytest.raises(
            SettingError, match=f"^{name} = .*: must be {re.escape(rule(annotation))}$"
        ) as told:
            kind(**{name: value})
        assert told.value.name == name


@given(st.data())
def test_numbers_within_their_range_are_taken_whatever_their_type(data):
    kind, name, annotation = data.draw(st.sampled_from(RANGED))
    value = data.draw(
        st.from_type(ranged(annotation)).filter(math.isfinite).filter(lambda v: abs(v) < 2**52)
    )
    python = limits(annotation)[0]
    for given_value in (
        value,
        np.float64(value),
        np.array(value),
        *([np.int64(value), float(value)] if python is int else []),
    ):
        made = kind(**{name: given_value})
        assert getattr(made, name) == value
        assert type(getattr(made, name)) is python
        assert dataclasses.replace(made) == made == pickle.loads(pickle.dumps(made))


@pytest.mark.every_case
@pytest.mark.parametrize(
    ("kind", "name", "annotation"), [s for s in SETTINGS if get_origin(s[2]) is Literal]
)
def test_words_are_those_that_are_listed(kind, name, annotation):
    for word in get_args(annotation):
        assert getattr(kind(**{name: word}), name) == word
    for wrong in ("", "half", word.upper(), None, 1):
        with pytest.raises(SettingError, match=re.escape(rule(annotation))):
            kind(**{name: wrong})


def test_precisions_may_be_members_of_their_enumeration():
    assert wl.MPRGP(precision=wl.Precision.SINGLE) == wl.MPRGP(precision="single")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: wl.CycleSettings(gamma=0), "gamma = 0: must be an integer >= 1"),
        (lambda: wl.CycleSettings(gamma=1.5), "gamma = 1.5: must be an integer >= 1"),
        (lambda: wl.CycleSettings(interval=(2.0, 0.5)), "interval = (2.0, 0.5): must be in order"),
        (
            lambda: wl.CycleSettings(interval=(0.0, 0.5)),
            "interval = (0.0, 0.5): must be a tuple, each a finite number > 0",
        ),
        (
            lambda: wl.CycleSettings(semicoarsening_threshold=1.1),
            "semicoarsening_threshold = 1.1: must be in [0, 1]",
        ),
        (lambda: wl.MPRGP(cycle={"gamma": 1}), "cycle = {'gamma': 1}: must be a CycleSettings"),
        (lambda: wl.MinimumMapNewton(direct=1), "direct = 1: must be True or False"),
        (lambda: wl.ProjectedSOR(omega=2), "omega = 2: must be in (0, 2) or None"),
        (lambda: wl.ProjectedJacobi(omega=0), "omega = 0: must be a finite number > 0 or None"),
        (
            lambda: wl.FischerNewton(fischer_weight=0.0),
            "fischer_weight = 0.0: must be in (0, 1] or None",
        ),
        (lambda: wl.InteriorPoint(backoff=1.0), "backoff = 1.0: must be in (0, 1)"),
        (
            lambda: wl.SubspaceMinimization(backtracks=-2),
            "backtracks = -2: must be an integer >= -1",
        ),
        (lambda: wl.StoppingCriteria(max_seconds=0), "max_seconds = 0: must be > 0 or inf"),
        (lambda: wl.StoppingCriteria(divergence=1), "divergence = 1: must be > 1 or inf"),
        (lambda: wl.StoppingCriteria(atol=math.inf), "atol = inf: must be a finite number >= 0"),
        (
            lambda: wl.Staggering(solvers="lemke"),
            "solvers = 'lemke': must be a Solver or a Sequence, each a Solver",
        ),
        (
            lambda: checked("word", "x" * 1000, Literal["a"]),
            "word = 'xxxxxxxxxxxx...xxxxxxxxxxxxx': must be 'a'",
        ),
    ],
)
def test_messages_name_setting_value_and_range(make, message):
    with pytest.raises(ValueError, match="^" + re.escape(message) + "$"):
        make()


def test_the_limits_themselves():
    """Limits by hand: a range with a wrong end refuses valid values."""
    taken = wl.StoppingCriteria(
        rtol=0, max_iterations=1e4, max_seconds=math.inf, divergence=math.inf, patience=np.int32(1)
    )
    assert repr(taken) == (
        "StoppingCriteria(rtol=0.0, atol=0.0, max_iterations=10000, patience=1, divergence=inf, "
        "max_seconds=inf, merits=False)"
    )
    assert wl.CycleSettings(gamma=1, semicoarsening_threshold=1.0, one_launch_cuda=0).gamma == 1
    assert (
        wl.FischerNewton(fischer_weight=1.0, warm_start=0, monotone_cycles=0).fischer_weight == 1.0
    )
    assert wl.BlockedGaussSeidel(blocks=[[0, 1], [2]]).blocks == [[0, 1], [2]]
    assert wl.BlockedGaussSeidel(blocks=wl.GridLines.Y).blocks is wl.GridLines.Y


def test_pydantic_is_imported_with_the_first_settings_only():
    code = (
        "import sys, warp_lcp as wl; a = 'pydantic' in sys.modules; wl.StoppingCriteria(); "
        "print(a, 'pydantic' in sys.modules)"
    )
    assert subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split() == ["False", "True"]


def test_methods_keep_their_signature():
    assert str(inspect.signature(wl.MPRGP)).startswith("(*, precision:")


def test_old_names_are_taken_with_a_warning_that_gives_the_new_one():
    for kind, old, new, value in (
        (wl.FischerNewton, "share", "fischer_weight", 0.5),
        (wl.GradientDescent, "share", "fischer_weight", 0.5),
        (wl.CycleSettings, "semi", "semicoarsening_threshold", 0.25),
        (wl.CycleSettings, "excess", "dirichlet_scaling", 1.25),
    ):
        with pytest.warns(
            DeprecationWarning,
            match=rf"{kind.__name__}\({old}=\.\.\.\) is now {kind.__name__}\({new}=\.\.\.\)",
        ):
            assert kind(**{old: value}) == kind(**{new: value})
        with pytest.raises(TypeError, match=f"got both {old} and {new}"):
            kind(**{old: value, new: value})


def test_old_names_of_modules_and_methods_warn_and_give_the_new_ones():
    with pytest.warns(
        DeprecationWarning, match=r"staggered\.Trail is now warp_lcp\.grid\.staggered\.DirtyRegion"
    ):
        assert staggered.Trail is staggered.DirtyRegion
    with pytest.warns(DeprecationWarning, match="DensityMonitor"):
        assert density_correction.Crowding is density_correction.DensityMonitor
    with pytest.raises(AttributeError, match="no attribute 'Trace'"):
        staggered.Trace  # noqa: B018

    class WithOldMethodName:
        def twice(self, number: int) -> int:
            return 2 * number

        double = renamed_method("double", twice)

    class SubclassOfRenamed(WithOldMethodName):
        def twice(self, number: int) -> int:
            return 2 * number + 1

    with pytest.warns(
        DeprecationWarning, match=r"SubclassOfRenamed\.double is now SubclassOfRenamed\.twice"
    ):
        assert SubclassOfRenamed().double(2) == 5
