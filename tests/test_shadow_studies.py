"""Studies and benchmarks of shadow fields, and settings that meet a tolerance."""

import dataclasses

import numpy as np
import pytest
from lengths import but

from diffopt import shadows
from diffopt.accuracy import benchmarks, shadow_benchmarks, shadow_scenes, studies
from diffopt.errors import InputError
from diffopt.kernels import rescaling_matrices
from diffopt.shadows import ShadowSettings, choosing

pytestmark = pytest.mark.float32


def run_some(name, which):
    """A few of a study's quick cases."""
    study = studies.study(name)
    cases = study.cases(True)
    picked = [cases[i] for i in which]
    return dataclasses.replace(study, cases=lambda quick: picked).run(quick=True, repeats=1)


def test_more_shells_err_less():
    rows = run_some("shadow.map", (-2, -1)).rows
    assert [row.settings["shells"] for row in rows] == [1, 2]
    assert rows[1].error < 0.8 * rows[0].error
    assert "floor 0.008" in rows[0].note
    assert "ms" in rows[0].note


def test_few_rays_err_more():
    rows = run_some("shadow.rays", (-2, -1)).rows
    assert [row.settings["rays"] for row in rows] == [8, 32]
    assert rows[1].error < rows[0].error


@pytest.mark.long
def test_occluders_in_the_study():
    rows = run_some("shadow.combination", (0, 1, 2)).rows
    assert [row.settings["combination"] for row in rows] == ["sum", "product", "exponential"]
    # Four bands leave out 0.010; none is far from it where objects hardly overlap.
    assert all(0.009 < row.error < 0.014 for row in rows)


@pytest.mark.parametrize("name", [n for n in studies.NAMES if n.startswith("shadow.")])
def test_cases_are_different(name):
    for quick in (True, False):
        found = [tuple(case.settings.items()) for case in studies.study(name).cases(quick)]
        assert len(set(found)) == len(found) > 2


@pytest.mark.parametrize("tolerance", but({0.05, 0.005}, [0.05, 0.02, 0.01, 0.005]))
def test_settings_meet_their_tolerance(tolerance):
    """On a scene outside, and where some receivers are inside."""
    for name, inside in (("torus tilted", False), ("torus flat", True)):
        settings = choosing.settings_for(tolerance, receivers_inside=inside)
        right = shadow_scenes.solved(name, 24, 48)
        light = shadows.distant_light(shadow_scenes.radiance, settings.bands)
        fields = [
            shadows.shadow_field(
                body.vertices,
                body.faces,
                settings,
                receivers=right.points,
                centre=body.centre,
                radius=body.radius,
            )
            for body in shadow_scenes.bodies(name)
        ]
        found = shadows.irradiance(right.points, np.array([0.0, 0.0, 1.0]), fields, light)
        assert shadow_scenes.rms(found / right.unshadowed, right) <= tolerance


def test_smaller_tolerances_cost_more():
    def cost(tolerance, **options):
        s = choosing.settings_for(tolerance, **options)
        return s.bands**2, s.shells * np.prod(s.directions) * s.rays**2

    costs = [cost(t) for t in (0.1, 0.03, 0.015, 0.007, 0.004)]
    assert costs == sorted(costs)
    assert cost(0.03, receivers_inside=True) >= cost(0.03)
    assert cost(0.013, occluders=2) >= cost(0.013)


def test_the_table_is_in_order():
    """Each line errs less somewhere than all before it: else it would never be taken."""
    best = np.full(3, np.inf)
    for choice in choosing.CHOICES:
        errors = np.array(choice[4:])
        assert (errors < best).any()
        best = np.minimum(best, errors)
        ShadowSettings(*choice[:1], choice.directions, choice.rays, choice.shells)


def test_no_settings_meet_too_small_a_tolerance():
    with pytest.raises(InputError, match=r"tolerance 1e-05 is met by no settings .* outside"):
        choosing.settings_for(1e-5)
    with pytest.raises(InputError, match=r"within the bounding sphere: the smallest is 0\.00"):
        choosing.settings_for(1e-5, receivers_inside=True)
    with pytest.raises(InputError, match=r"tolerance must be a relative error in \(0, 1\)"):
        choosing.settings_for(-1.0)
    with pytest.raises(InputError, match="occluders must be a whole number from 1; received 0"):
        choosing.settings_for(0.01, occluders=0)


def test_matrices_in_all_forms_agree():
    entries = shadow_benchmarks._matrices("small")[:3]
    k, views = (a[..., :200] for a in entries[0].arguments)
    right = rescaling_matrices.apply(rescaling_matrices.tangent(k, 4, nodes=48), views, 4)
    # Tables of 48 nodes and 12 terms: 1e-3 of the entries, sixteen of them in a sum.
    for entry in entries:
        np.testing.assert_allclose(entry.function(k, views), right, atol=5e-3)


@pytest.mark.long
def test_carrying_is_faster_than_sampling():
    """Four shells for 48 distances: about twelve times fewer rays."""
    rows = benchmarks.run(["shadow.distances"], repeats=1)
    assert rows[0].name == "shadow.distances/carried"
    assert rows[1].run_s > 3.0 * rows[0].run_s
    assert "ns per distance; to carried: run x" in rows[1].note
