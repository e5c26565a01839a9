"""Tie points of the new images (pairs that are matched, wrong matches, how many rays), and shared position fixes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from georef.config import AdjustConfig
from georef.estimation.epoch_problem import match_pair, pose_sigma_px, position_priors, tie_pairs
from georef.estimation.tracks import PairMatches
from georef.features.nearest import MutualNearest
from georef.types.campaign import PositionPrior
from georef.types.results import Localized
from tests.worlds.blocks import block
from tests.worlds.points import Seen, court, loose_cov, new_image, photograph


def photographs(seed: int, **options: float) -> tuple[list[Seen], list[Localized]]:
    world, rng = court(seed, queries=5, points=400), np.random.default_rng(seed)
    seen = [photograph(world, pose, rng, **options) for pose in world.queries]  # pyright: ignore[reportArgumentType]
    results = []
    for i, image in enumerate(seen):
        points = world.points[image.point[image.point >= 0]]
        cov = loose_cov(image.truth, 0.02, 0.001)
        results.append(Localized(f"q{i}", image.truth, cov, cov, len(points), 1.0, (), points, np.arange(len(points))))
    return seen, results


def test_each_image_is_matched_with_the_neighbours_that_see_most_of_it() -> None:
    seen, results = photographs(1)
    images = [s.posed() for s in seen]
    everything = tie_pairs(images, results, 4)
    assert everything == [(i, j) for i in range(5) for j in range(i + 1, 5)]
    few = tie_pairs(images, results, 1)
    assert set(few) < set(everything)
    assert {i for pair in few for i in pair} == set(range(5))
    assert (0, 4) not in few  # the outermost of the row share least


def test_matches_off_the_epipolar_lines_are_left_out() -> None:
    seen, results = photographs(2, blunders=0.3)
    images = [s.posed() for s in seen]
    pairs = tie_pairs(images, results, 4)
    pose_px = [pose_sigma_px(image.camera, result) for image, result in zip(images, results, strict=True)]

    def matched(keypoints: int) -> list[PairMatches]:
        return [
            PairMatches(
                i, j, match_pair((images[i], images[j]), (pose_px[i], pose_px[j]), MutualNearest(), keypoints, 3.0)
            )
            for i, j in pairs
        ]

    found = matched(1000)
    assert all(len(m.indices) >= 15 for m in found)
    wrong = np.concatenate(
        [seen[m.a].blunder[m.indices[:, 0]] | seen[m.b].blunder[m.indices[:, 1]] for m in found]
    ).mean()
    assert wrong < 0.16  # of 0.5 among all matches; along the line nothing tells, and the poses allow for 3 px
    assert max(int(m.indices.max(initial=0)) for m in matched(100)) < 100


def test_a_tie_point_has_as_many_rays_as_asked_for() -> None:
    for rays in (2, 3, 4):
        config = AdjustConfig(gnss=False, min_tie_point_rays=rays, max_tie_points_per_image=5000)
        problem = block(3, references=2, queries=6, config=config).problem
        count = np.bincount(problem.observations.point, minlength=len(problem.points))
        tie = np.ones(len(problem.points), bool)
        tie[problem.gcps.point] = False
        assert tie.sum() > 3
        assert (count[tie] >= rays).all()


def test_images_of_one_station_share_its_position_fix() -> None:
    """Together they know what was measured, and no more."""
    seen, results = photographs(4)
    fix = np.diag([0.04, 0.09, 0.25])
    stations = ["pano", None, "pano", None]
    images = [
        replace(new_image(f"q{i}", s.truth.translation), gnss=PositionPrior(s.truth.translation, fix), station=station)
        for i, (s, station) in enumerate(zip(seen[:4], stations, strict=True))
    ]
    priors = position_priors(images, [results[0], replace(results[1], gnss_rejected=True), results[2], results[3]])
    assert sorted(priors) == [0, 2, 3]
    together = sum(np.linalg.inv(priors[i].cov) for i in (0, 2))
    np.testing.assert_allclose(np.linalg.inv(together), fix)
    np.testing.assert_allclose(priors[3].cov, fix)
