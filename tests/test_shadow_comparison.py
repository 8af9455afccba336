"""``diffopt compare shadows``: errors beside their floor, by every map."""

import csv

import pytest

from diffopt.accuracy import shadow_comparison
from diffopt.cli import main
from diffopt.errors import InputError


@pytest.fixture(scope="module")
def found():
    return shadow_comparison.compare(
        ["sphere"],
        ["square", "tangent", "default"],
        bands=[3],
        side=12,
        polar=16,
        receivers=50,
        repeats=1,
    )


def test_maps_are_ordered_and_none_is_below_its_floor(found, tmp_path):
    square, tangent, default = found.rows
    # The tangent map is exact for a sphere about its centre: what remains is the floor, to the
    # resolution of 32 x 32 rays.
    for row in (tangent, default):
        assert row.error == pytest.approx(row.floor, rel=0.1)
    assert square.error > 3.0 * square.floor
    assert all(row.floor == square.floor for row in found.rows)
    assert all(0.0 < row.receiver_ns <= row.frame_ns for row in found.rows)
    found.save_csv(tmp_path / "found.csv")
    with (tmp_path / "found.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["method"] for line in lines] == ["square", "tangent", "default"]
    assert float(lines[0]["error"]) == square.error
    assert "tangent" in str(found)


def test_what_it_does_not_know_is_named():
    with pytest.raises(InputError, match=r"scene must be one of capsule.*'cube'"):
        shadow_comparison.compare(["cube"])
    with pytest.raises(InputError, match=r"method must be one of square.*'round'"):
        shadow_comparison.compare(["sphere"], ["round"])


def test_command_refuses_bands_that_are_none(capsys):
    assert main(["compare", "shadows", "--bands", "4,x"]) == 2
    assert "4,x" in capsys.readouterr().err
