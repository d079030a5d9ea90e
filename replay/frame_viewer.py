"""Frames as a rerun recording: the sweep in body axes, and every camera where it sits, with what it saw.

Points are at the frame's time; each camera stands where it was at its exposure, so that what it shows lines up.
"""

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from replay.chosen_frames import ChosenFrame
from replay.frame_picture import around, colours
from replay.viewer import WRITING_S
from sensors.errors import EgolocError
from sensors.images import RAW, Image
from sensors.motion import points_at, relative

TIMELINE = "frame_time"
FRUSTUM_M = 2.0
"""How far before its camera an image stands."""
_KINDS = {"jpeg": "image/jpeg", "png": "image/png"}


def write_frames(chosen: Sequence[ChosenFrame], path: Path) -> None:
    """Write the recording, whole or not at all."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        partial.touch()  # rerun's own message would not be an OSError
        recording = rr.RecordingStream("egoloc_frames")
        recording.save(partial, default_blueprint=_blueprint(chosen))
        recording.log("body", rr.ViewCoordinates.FLU, static=True)
        for each in chosen:
            recording.set_time(TIMELINE, timestamp=np.datetime64(each.frame.t_ns, "ns"))
            _draw(recording, each)
        recording.flush(timeout_sec=WRITING_S)
        recording.disconnect()
        partial.replace(path)
    except (OSError, RuntimeError) as error:  # rerun's own, where the disk is full
        reason = error.strerror if isinstance(error, OSError) else error
        raise EgolocError(f"{path}: cannot be written: {reason}") from None
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def _draw(recording: rr.RecordingStream, chosen: ChosenFrame) -> None:
    frame, motion = chosen.frame, chosen.motion
    for number, sweep in enumerate(frame.sweeps):
        xyz = points_at(sweep, frame.t_ns, motion, frame.t_ns)
        shades = (255.0 * colours(np.linalg.norm(xyz[:, :2], axis=1))[:, :3]).astype(np.uint8)
        points = rr.Points3D(xyz, colors=shades, radii=rr.Radius.ui_points(1.3))
        recording.log(f"body/lidar/{number}", points)
    for image in frame.images:
        T = relative(motion, image.t_ns, frame.t_ns) @ image.T_body_camera
        entity = _entity(image)
        recording.log(entity, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        recording.log(
            entity,
            rr.Pinhole(
                image_from_camera=image.K,
                resolution=[image.width, image.height],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=FRUSTUM_M,
            ),
        )
        recording.log(f"{entity}/image", _picture(image))


def _entity(image: Image) -> str:
    return f"body/cameras/{image.name}"


def _picture(image: Image) -> rr.EncodedImage | rr.Image:
    """As recorded; rectified where a lens bends it, for the viewer knows pinholes alone."""
    if image.lens == "none" and image.format not in RAW:
        return rr.EncodedImage(contents=image.data, media_type=_KINDS[image.format])
    return rr.Image(image.rectified()).compress(jpeg_quality=90)


def _blueprint(chosen: Sequence[ChosenFrame]) -> rrb.Blueprint:
    """The cameras around the sweep."""
    first = {image.name: image for each in reversed(chosen) for image in each.frame.images}
    rows = [
        rrb.Horizontal(
            *(
                rrb.Spatial2DView(origin=_entity(image), contents=["$origin/**", "/body/lidar/**"], name=image.name)
                for image in row
            )
        )
        for row in around(list(first.values()))
    ]
    above = rrb.Spatial3DView(
        origin="/body",
        name="Body",
        background=(13, 16, 17),
        eye_controls=rrb.EyeControls3D(position=(-22.0, 0.0, 16.0), look_target=(6.0, 0.0, 0.0), eye_up=(0, 0, 1)),
    )
    return rrb.Blueprint(rrb.Vertical(*rows, above), collapse_panels=True)
