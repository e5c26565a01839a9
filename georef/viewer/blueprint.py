"""The layout that a recording opens with: the scene, the new images, the texts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb

from georef.geometry.rigid import Array

_MOST_IMAGE_TABS = 24
_VIEW_FROM = np.array([-0.1, -0.7, 0.55])  # of the extent, from the middle: from the south, above


def default_blueprint(
    image_paths: Sequence[tuple[str, str]],
    into_images: Sequence[str],
    hidden: Sequence[str],
    middle: Array,
    extent_m: float,
) -> rrb.Blueprint:
    """The layout.

    image_paths: name and entity path of each new image; into_images: entities that are projected into them; hidden:
    entities that are there but switched off.
    """
    scene = _scene_view(hidden, middle, extent_m)
    images = [_image_view(name, path, into_images) for name, path in image_paths[:_MOST_IMAGE_TABS]]
    texts = rrb.Tabs(
        rrb.TextDocumentView(origin="/summary", name="Summary"),
        rrb.TextDocumentView(origin="/rejected_images", name="Rejected images"),
        active_tab=0,
    )
    side = rrb.Vertical(rrb.Tabs(*images, active_tab=0), texts, row_shares=[3, 2]) if images else texts
    return rrb.Blueprint(
        rrb.Horizontal(scene, side, column_shares=[3, 2]), collapse_panels=True, auto_views=False, auto_layout=False
    )


def _scene_view(hidden: Sequence[str], middle: Array, extent_m: float) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin="/world",
        name="Scene",
        overrides={path: rrb.EntityBehavior(visible=False) for path in hidden},
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=middle + extent_m * _VIEW_FROM,
            look_target=middle,
            eye_up=[0.0, 0.0, 1.0],
        ),
    )


def _image_view(name: str, path: str, into_images: Sequence[str]) -> rrb.Spatial2DView:
    """An image with its measured marks and what is projected into it."""
    return rrb.Spatial2DView(
        origin=path, contents=["$origin/**", *[f"+ {entity}" for entity in into_images]], name=name
    )
