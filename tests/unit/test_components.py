"""Variance components: redundancies against the full design matrix, and misstated sigmas recovered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.estimation.adjustment import block as adjustment
from georef.estimation.adjustment.block import KINDS_OF_POINT, KINDS_OF_POSE
from georef.estimation.adjustment.equations.constraint_terms import POSITION_PRIORS
from georef.estimation.adjustment.equations.eliminate import IMAGE_OBSERVATIONS
from georef.estimation.adjustment.network import orientation_components
from georef.estimation.adjustment.quality.components import Component
from georef.geometry.projection import linearize
from georef.geometry.rigid import Array
from tests.worlds.adjusted import Solved, adjusted, images_alone
from tests.worlds.blocks import block, control, gnss, orientations, pose_priors, with_orientations
from tests.worlds.points import NOISE, scaled_noise

_EXACT = scaled_noise(NOISE, poses=1e-6)


def everything(seed: int) -> adjustment.Block:
    """All kinds of constraints at once; orientations and pose priors on different images."""
    made, rng = block(seed, noise=_EXACT, points=70), np.random.default_rng([seed, 8])
    given, priors = orientations(made.world, rng, 0.01, 3e-4), pose_priors(made.world, rng)
    problem = replace(
        made.problem,
        pose_priors={2: priors[2]},
        position_priors=gnss(made.world, rng, 0.05),
        control=control(made.world, rng, count=3),
    )
    return with_orientations(images_alone(problem), given, (0, 1))


def hat_traces(found: Solved) -> dict[str, float]:
    """tr(A Qxx A' P) of each group, from one dense whitened design matrix of all unknowns."""
    whole, state, poses = found.block, found.state, found.poses
    images = len(whole.image_ids)
    size = 6 * images + 3 * len(whole.points)
    rows: list[tuple[str, np.ndarray]] = []

    def add(group: str, blocks: dict[int, Array], cov: Array) -> None:
        row = np.zeros((len(cov), size))
        for column, part in blocks.items():
            row[:, column : column + part.shape[1]] = part
        rows.append((group, np.linalg.solve(np.linalg.cholesky(cov), row)))

    obs, lin = (
        whole.observations,
        linearize(whole.views(state), whole.observations.view, state.points[whole.observations.point]),
    )
    for i in range(len(obs)):
        columns = {6 * int(obs.view[i]): lin.by_pose[i], 6 * images + 3 * int(obs.point[i]): lin.by_point[i]}
        add(IMAGE_OBSERVATIONS, columns, np.eye(2) * obs.sigma_px[i] ** 2)
    points, given, positions = whole.point_priors, whole.pose_priors, whole.position_priors
    for point, information, kind in zip(points.point, points.information, points.kind, strict=True):
        cov = np.asarray(np.linalg.inv(information), dtype=np.float64)
        add(KINDS_OF_POINT[kind], {6 * images + 3 * int(point): np.eye(3)}, cov)
    for image, cov, kind in zip(given.image, given.cov, given.kind, strict=True):
        add(KINDS_OF_POSE[kind], {6 * int(image): np.eye(6)}, cov)
    for station, cov in zip(positions.station, positions.cov, strict=True):
        add(POSITION_PRIORS, {6 * int(station) + 3: poses[station].rotation}, cov)
    names = np.concatenate([[name] * len(row) for name, row in rows])
    basis, _ = np.linalg.qr(np.concatenate([row for _, row in rows]))
    leverage = np.square(basis).sum(axis=1)
    return {name: float(leverage[names == name].sum()) for name in dict.fromkeys(names.tolist())}


def test_redundancies_are_those_of_the_full_design_matrix_and_add_up() -> None:
    found = Solved.of(everything(1))
    expected, groups = hat_traces(found), found.quality.components
    assert set(groups) == set(expected) == {IMAGE_OBSERVATIONS, *KINDS_OF_POINT, *KINDS_OF_POSE, POSITION_PRIORS}
    for name, component in groups.items():
        # first order: the derivative of Log at a residual of a pose prior
        assert component.redundancy == pytest.approx(component.observations - expected[name], abs=0.02), name
    observations = sum(component.observations for component in groups.values())
    unknowns = 6 * len(found.block.image_ids) + 3 * len(found.block.points)
    assert sum(c.redundancy for c in groups.values()) == pytest.approx(observations - unknowns)
    assert sum(expected.values()) == pytest.approx(unknowns)


def test_positions_and_rotations_of_orientations_have_components_of_their_own() -> None:
    """Against residuals and cofactors of the poses themselves, and adding up to that of the orientations."""
    found = Solved.of(everything(2))
    whole = orientation_components(found.quality)
    both = found.quality.components["orientation"]
    expected = {"reference_position": [0.0, 0.0], "reference_rotation": [0.0, 0.0]}
    given = found.block.pose_priors
    for row in np.flatnonzero(given.kind == KINDS_OF_POSE.index("orientation")):
        image = int(given.image[row])
        pose, prior = found.poses[image], given.world_from_cam[int(row)]
        cov = found.cofactors[6 * image : 6 * image + 6, 6 * image : 6 * image + 6]
        offset, turn = pose.translation - prior.translation, prior.local(pose)[:3]
        in_world = pose.rotation @ cov[3:, 3:] @ pose.rotation.T
        for name, residual, fitted, sigma in (
            ("reference_position", offset, in_world, 0.01),
            ("reference_rotation", turn, cov[:3, :3], 3e-4),
        ):
            expected[name][0] += 3.0 - np.trace(fitted) / sigma**2
            expected[name][1] += np.sum(np.square(residual)) / sigma**2
    for name, (redundancy, squares) in expected.items():
        assert whole[name].observations == 6
        assert whole[name].redundancy == pytest.approx(redundancy, abs=2e-3), name
        assert whole[name].squares == pytest.approx(squares, rel=2e-3), name
    assert sum(part.squares for part in whole.values()) == pytest.approx(both.squares)
    assert sum(part.redundancy for part in whole.values()) == pytest.approx(both.redundancy)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_misstated_keypoint_sigma_is_recovered(factor: float) -> None:
    """Stated sigmas are `factor` times the true ones: the scale of the adjustment is 1 / factor."""
    scales, left = [], []
    for seed in range(4):
        found = adjusted(scaled(images_alone(block(seed, noise=_EXACT, points=250).problem), factor))
        scales.append(found.adjusted.sigma_scale)
        left.append(found.quality.components[IMAGE_OBSERVATIONS].factor)
    assert np.mean(scales) * factor == pytest.approx(1.0, abs=0.04)
    assert left == pytest.approx([1.0] * 4, abs=0.06)


def scaled(whole: adjustment.Block, factor: float) -> adjustment.Block:
    """The sigmas of all keypoints scaled, those behind the automatic GCPs included."""
    points = replace(whole.point_priors, information=whole.point_priors.information / factor**2)
    return replace(whole, observations=whole.observations.scaled(factor), point_priors=points)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_misstated_gnss_and_control_sigmas_show_in_their_factors_alone(factor: float) -> None:
    found: dict[str, list[Component]] = {POSITION_PRIORS: [], "control": [], IMAGE_OBSERVATIONS: []}
    for seed in range(12):
        made, rng = block(seed, noise=_EXACT, points=90), np.random.default_rng([seed, 10])
        priors = gnss(made.world, rng, 0.05)
        problem = replace(
            made.problem,
            position_priors={i: replace(p, cov=p.cov * factor**2) for i, p in priors.items()},
            control=tuple(replace(p, cov=p.cov * factor**2) for p in control(made.world, rng, sigma_m=0.03)),
        )
        components = Solved.of(images_alone(problem)).quality.components
        for name, values in found.items():
            values.append(components[name])
    for name, expected in ((POSITION_PRIORS, 1.0 / factor), ("control", 1.0 / factor), (IMAGE_OBSERVATIONS, 1.0)):
        squares, redundancy = (sum(getattr(c, key) for c in found[name]) for key in ("squares", "redundancy"))
        pooled = Component(0, redundancy, squares)
        assert pooled.factor is not None
        assert pooled.factor_sigma is not None
        assert pooled.factor == pytest.approx(expected, abs=4.0 * pooled.factor_sigma), name
        assert pooled.factor_sigma < 0.12 * expected
        scatter = np.std([c.factor or np.nan for c in found[name]])
        stated = np.mean([c.factor_sigma or np.nan for c in found[name]])
        assert 0.5 < scatter / stated < 1.7, name


def test_a_group_without_redundancy_has_no_factor() -> None:
    assert Component(6, 2.9, 1.0).factor is None
    assert Component(6, 2.9, 1.0).factor_sigma is None
    assert Component(6, 4.0, 16.0).factor == pytest.approx(2.0)
