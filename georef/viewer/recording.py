"""The rerun recording of an epoch: cameras with their pictures, points, check points and their residuals.

Everything is in the metric world frame: rerun keeps positions as float32, which cannot hold grid coordinates. Nothing
is sent anywhere and no viewer is started; the file is put in place when it is complete.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr

from georef.config import ReportConfig
from georef.replacing import replacing
from georef.viewer.blueprint import default_blueprint
from georef.viewer.cameras import log_cameras
from georef.viewer.scene import Scene
from georef.viewer.surveyed import log_check_points, log_control_points, log_moves, log_sigmas
from georef.viewer.texts import rejected_text, summary_text
from georef.viewer.writer import Writer


def write_recording(scene: Scene, config: ReportConfig, path: Path) -> None:
    """Writes the recording with its default blueprint; an existing one stays until the new one is complete."""
    with replacing(path, ".rrd") as temporary:
        _write_stream(scene, config, temporary)


def _write_stream(scene: Scene, config: ReportConfig, path: Path) -> None:
    stream = rr.RecordingStream("georef", recording_id=scene.run)
    try:
        stream.save(path)
        writer = Writer(scene, stream, config.recording_image_side_px)
        _write_entities(writer, config.recording_max_points)
        middle, extent = scene.focus
        stream.send_blueprint(default_blueprint(writer.image_paths, writer.into_images, writer.hidden, middle, extent))
        stream.send_recording_name(scene.title)
    finally:
        stream.disconnect()  # writes what is left and closes the file


def _write_entities(writer: Writer, most_points: int) -> None:
    scene = writer.scene
    writer.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    log_cameras(writer)
    _log_points(writer, most_points)
    log_check_points(writer)
    log_control_points(writer)
    log_moves(writer)
    log_sigmas(writer)
    text = summary_text(scene.title, scene.report, writer.legend)
    writer.log("summary", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
    writer.log("rejected_images", rr.TextDocument(rejected_text(scene.rejected), media_type=rr.MediaType.MARKDOWN))


def _log_points(writer: Writer, most: int) -> None:
    points, colors = writer.scene.points, writer.scene.colors_rgb
    if len(points) > most:
        chosen = np.sort(np.random.default_rng(0).choice(len(points), most, replace=False))
        points, colors = points[chosen], colors[chosen]
    if len(points):
        writer.log("world/points", rr.Points3D(points, colors=colors, radii=rr.Radius.ui_points(1.8)))
        writer.legend.append(("world/points", f"{len(points)} of {len(writer.scene.points)} points of the adjustment"))
