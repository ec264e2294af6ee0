"""Files of measurements: what is read, and what is refused in one sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softgrasp.fem.columns import hand_columns
from softgrasp.fem.errors import SceneError
from softgrasp.reduction.identify.data import (
    Measurements,
    check,
    interpolation,
    parse_noise,
    read_measurements,
    with_distinct_names,
)

TIP, HAND = hand_columns(2, 2, "tip"), hand_columns(2, 2, "q")


def write(folder: Path, *lines: str) -> Path:
    file = folder / "data.csv"
    file.write_text("\n".join(lines) + "\n")
    return file


def rows(n: int = 8, x: str = "0.{i}", y: str = "1.{i}") -> list[str]:
    return [f"0.{i},{x.format(i=i)},{y.format(i=i)}" for i in range(n)]


def test_columns_may_stand_in_any_order_and_cells_may_be_empty(tmp_path: Path) -> None:
    file = write(
        tmp_path, "time [s],q_y [m],tip_y [m],q_x [m]", "0,1,,2", "0.5,,3,4", *(f"{i},5,{i},6" for i in range(1, 9))
    )
    found = read_measurements(file, TIP, HAND, 1.0, 2.0)
    assert found.times[0] == 0.5  # a line of the hand alone is none of the outputs
    np.testing.assert_array_equal(found.values[0], [np.nan, 3])
    assert found.hand is not None
    np.testing.assert_array_equal(found.hand[0], [0, *range(1, 9)])
    np.testing.assert_array_equal(found.hand[1][:2], [[2, 1], [6, 5]])
    plain = read_measurements(write(tmp_path, "t,tip_x,tip_y", *rows()), TIP, HAND, 1.0, 2.0)
    assert plain.hand is None
    assert plain.values.shape == (8, 2)


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ([], "the first column must be 'time [s]'"),
        (["tip_x,tip_y", "1,2"], "the first column must be 'time [s]'"),
        (["time [s],nose_x [m]", "0,1"], "'nose_x [m]' is no output of the scene; the columns can be tip_x [m]"),
        (["time [s],tip_x [mm]", "0,1"], "'tip_x [mm]' is no output"),
        (["t,tip_x,tip_x [m]", "0,1,1"], "a column is given twice"),
        (["t,tip_x,tip_y", *rows(3), "0.2,1,1", *rows()], "line 5: times must be given in each line and increase"),
        (["t,tip_x,tip_y", *rows(3), ",1,1"], "line 5: times must be given"),
        (["t,tip_x,tip_y", *rows(3), "0.9,1"], "line 5 has 2 cells; it must have 3"),
        (["t,tip_x,tip_y", *rows(3), "0.9,1,nan"], "line 5: 'nan' is not finite; leave the cell"),
        (["t,tip_x,tip_y", *rows(3), "0.9,1,left"], "line 5: 'left' is no number"),
        (["t,tip_x,tip_y", *rows(1)], "2 measured numbers are too few; give at least 8"),
        (["t,tip_x,tip_y", *rows(8, "1", "2")], "no output moves"),
        (["t,tip_x,tip_y", *rows(8, "{i}000")], "tip_x is 7e+03 m, and the body is 2 m long; give metres"),
        (
            ["t,tip_x,tip_y,q_x,q_y", *(f"{row},{i}000,0" for i, row in enumerate(rows()))],
            "the hand moves to 7e+03 m, and the body is 2 m long; give metres",
        ),
        (["t,tip_x,tip_y", *rows(), "9,1,1"], "the times run from 0 to 9 s, and the hand moves from 0 to 1 s"),
        (["t,tip_x,tip_y", "-1,1,1", *rows()], "the times run from -1 to 0.7 s"),
        (["t,tip_x,q_x", *rows()], "a measured hand must have all its positions at 0 s"),
    ],
)  # fmt: skip
def test_bad_files_are_refused_in_one_sentence(tmp_path: Path, lines: list[str], says: str) -> None:
    file = write(tmp_path, *lines)
    with pytest.raises(SceneError) as error:
        read_measurements(file, TIP, HAND, 1.0, 2.0)
    assert str(error.value).startswith(str(file))
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_arrays_are_checked_as_files_are() -> None:
    times, values = np.linspace(0, 1, 9), np.arange(18.0).reshape(9, 2)
    check("camera", Measurements("camera", times, values), 1.0, 2.0, TIP)
    for t, y, says in (
        (times[::-1], values, "times must be finite and increase"), (times * np.nan, values, "times must be finite"),
        (times, values + np.inf, "an output is infinite; a missing sample is nan"),
        (times, values * np.nan, "0 measured numbers are too few"), (times[:1], values[:1], "2 measured numbers"),
        (times, 0 * values + 1, "no output moves"), (times, 1e4 * values, "the body is 2 m long; give metres"),
        (times + 1, values, "the times run from 1 to 2 s, and the hand moves from 0 to 1 s"),
    ):  # fmt: skip
        with pytest.raises(SceneError, match=r"^camera: ") as error:
            check("camera", Measurements("camera", t, y), 1.0, 2.0, TIP)
        assert says in str(error.value)


def test_files_that_are_none_are_refused(tmp_path: Path) -> None:
    binary = tmp_path / "image.csv"
    binary.write_bytes(bytes(range(256)))
    for file in (tmp_path / "none.csv", tmp_path, binary):
        with pytest.raises(SceneError, match="cannot be read"):
            read_measurements(file, TIP, HAND, 1.0, 2.0)


def test_noise_is_of_all_outputs_or_of_each() -> None:
    np.testing.assert_array_equal(parse_noise("1e-3", TIP), [1e-3, 1e-3])
    np.testing.assert_array_equal(parse_noise("tip=1, tip_y=2", TIP), [1, 2])
    for text in ("", "0", "nan", "inf", "x", "tip=", "=1"):
        with pytest.raises(SceneError, match=r"^--noise"):
            parse_noise(text, TIP)


@pytest.mark.parametrize("steps", [1, 2, 3, 10])
def test_interpolation_is_exact_for_cubics_between_the_steps(steps: int) -> None:
    dt, times = 0.1, np.linspace(0, 0.1 * steps, 37)
    degree = min(3, steps)
    f = np.polynomial.Polynomial([0.3, -1.0, 2.0, 5.0][: degree + 1])
    W = interpolation(times, dt, steps)
    assert np.abs(W @ f(dt * np.arange(steps + 1)) - f(times)).max() < 1e-14  # rounding of numbers of size one
    late = interpolation(np.array([-1.0, 99.0]), dt, steps) @ np.arange(steps + 1.0)
    np.testing.assert_allclose(late, [0, steps], atol=1e-14)  # the ends


def test_angles_are_compared_with_turns_and_not_with_lengths(tmp_path: Path) -> None:
    turning = hand_columns(3, 2, "hand")
    lines = ["t,hand_x,hand_rz", *(f"0.{i},0.0{i},0.{i}" for i in range(8))]
    # 0.7 rad on a body of 0.1 mm, which is 7000 of its lengths
    assert read_measurements(write(tmp_path, *lines), turning, HAND, 1.0, 1e-4).values[7, 2] == 0.7
    degrees = write(tmp_path, "t,hand_x,hand_rz", *(f"0.{i},0,{20 * i}" for i in range(8)))
    with pytest.raises(SceneError, match="hand_rz is 140 rad, more than two turns; give radians"):
        read_measurements(degrees, turning, HAND, 1.0, 2.0)


def test_files_of_one_name_get_numbers() -> None:
    one, other = (Measurements(name, np.zeros(0), np.zeros((0, 2))) for name in ("camera.csv", "other.csv"))
    assert [d.name for d in with_distinct_names([one, other, one])] == ["camera.csv (1)", "other.csv", "camera.csv (2)"]
