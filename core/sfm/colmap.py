# SPDX-License-Identifier: GPL-3.0-or-later
"""COLMAP at work, inside the child process: the one module that imports pycolmap. Files in, files out.

A job is a dictionary that JSON can hold:

    frames       per frame, the file names of its pictures in `pictures`, one per camera in order, null where missing
    pictures     folder of the pictures; `masks`, if not null, a folder with a mask NAME.png for some of them
    cameras      per camera: model, width, height, params (COLMAP's order), known (else params are a guess), and lens,
                 a number that cameras of one lens share
    pairs        which cameras to match with each other, [[a, b], ...]
    work         an empty folder for the database
    out          the .npz to write
    options      max_size, max_features, affine, guided, threads, min_angle_degrees, max_error_px
    poses        `triangulate` alone: per camera, world-to-camera, 4 rows of 4

The result is one .npz of plain arrays:

    keypoints_C          (n, 2) float32, pixels of camera C with centers at +0.5; those of all frames together
    pairs, matches_K     (P, 2) camera indices; (m, 2) indices of keypoints of pairs[K] that COLMAP could verify
    xyz, error           (N, 3) and (N,) float64: points, and their mean reprojection errors in pixels
    offsets              (N + 1,): the observations of point i are offsets[i]:offsets[i + 1] of the next two
    camera, keypoint     (M,): camera index and keypoint index of each observation
    poses, registered    `reconstruct` alone: (C, 4, 4) world-to-camera, (C,) bool
    params               `reconstruct` alone: (C, p), the lens of each camera
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..files import atomic_path

Emit = Callable[[dict[str, Any]], None]
Arrays = dict[str, NDArray[Any]]

SEED = 0
MIN_MATCHES = 15  # fewer inliers of two pictures are no evidence that they see the same
_RELAXED_ANGLES_DEGREES = (16.0, 8.0, 4.0, 2.0)  # between the first two cameras; COLMAP's own, then smaller


def triangulate(job: dict[str, Any], emit: Emit) -> dict[str, Any]:
    """Triangulate points with known poses; write the arrays above and return how many points there are."""
    database = _matched(job, emit)
    emit({"event": "stage", "stage": "points"})
    known = pycolmap.Reconstruction()
    for lens, camera in {camera["lens"]: camera for camera in reversed(job["cameras"])}.items():
        known.add_camera_with_trivial_rig(_camera(camera, lens + 1))
    for index, camera in enumerate(job["cameras"]):
        pose = np.array(job["poses"][index], np.float64)
        image = pycolmap.Image(name=str(index), camera_id=camera["lens"] + 1, image_id=index + 1)
        rotation = pycolmap.Rotation3d(pose[:3, :3])
        known.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, pose[:3, 3]))
    matches = _verified(job, database)
    if matches:  # those above are judged without the poses, to judge the poses by; points take what fits the poses
        pycolmap.guided_geometric_verification(
            known, database, two_view_geometry_options=_verification(), num_threads=job["options"]["threads"]
        )
    options = _mapper_options(job)
    result = pycolmap.triangulate_points(
        known, database, job["pictures"], _folder(job, "out"), options=options, refine_intrinsics=False
    )
    return _finish(job, database, matches, _points(result))


def reconstruct(job: dict[str, Any], emit: Emit) -> dict[str, Any]:
    """Find poses and lenses too; write the arrays above and return how many points there are."""
    database = _matched(job, emit)
    emit({"event": "stage", "stage": "poses"})
    matches = _verified(job, database)
    connected = {camera for pair in matches for camera in pair}
    best = None
    for attempt, angle in enumerate(_RELAXED_ANGLES_DEGREES):
        options = _mapper_options(job)
        options.min_model_size = 2
        options.mapper.init_min_tri_angle = angle
        if attempt:  # few cameras, far apart, have little in common
            options.mapper.init_min_num_inliers = 40
            options.mapper.abs_pose_min_num_inliers = 15
        models = pycolmap.incremental_mapping(database, job["pictures"], _folder(job, f"out{attempt}"), options=options)
        for model in models.values():
            if best is None or _rank(model) > _rank(best):
                best = model
        if best is not None and best.num_reg_images() >= len(connected):
            break
    found = {} if best is None else _points(best) | _poses(best, job)
    return _finish(job, database, matches, found)


def _rank(model: pycolmap.Reconstruction) -> tuple[int, int]:
    return model.num_reg_images(), model.num_points3D()


def _folder(job: dict[str, Any], name: str) -> Path:
    folder = Path(job["work"]) / name
    folder.mkdir(parents=True)
    return folder


def _camera(camera: dict[str, Any], camera_id: int) -> pycolmap.Camera:
    return pycolmap.Camera(
        camera_id=camera_id,
        model=camera["model"],
        width=camera["width"],
        height=camera["height"],
        params=camera["params"],
        has_prior_focal_length=camera["known"],
    )


def _mapper_options(job: dict[str, Any]) -> pycolmap.IncrementalPipelineOptions:
    wanted = job["options"]
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = wanted["threads"]
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.min_num_matches = MIN_MATCHES
    options.extract_colors = False
    options.triangulation.ignore_two_view_tracks = False
    options.triangulation.min_angle = options.mapper.filter_min_tri_angle = wanted["min_angle_degrees"]
    options.mapper.filter_max_reproj_error = wanted["max_error_px"]
    return options


def _matched(job: dict[str, Any], emit: Emit) -> Path:
    """Find features in all pictures and match those of each frame; return a database with one image per camera.

    Cameras stand still, so the features of all frames of a camera are features of one image; only matches are bound to
    their frame.
    """
    pycolmap.set_random_seed(SEED)
    emit({"event": "stage", "stage": "features"})
    by_picture = Path(job["work"]) / "pictures.db"
    _extract(job, by_picture)
    emit({"event": "stage", "stage": "matches"})
    _match(job, by_picture)
    merged = Path(job["work"]) / "cameras.db"
    pairs = _merge(job, by_picture, merged)
    if pairs:
        pycolmap.verify_matches(merged, _pairs_file(job, pairs), _verification())
    return merged


def _extract(job: dict[str, Any], path: Path) -> None:
    wanted = job["options"]
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_PINHOLE"  # the true ones follow
    if job["masks"] is not None:
        reader.mask_path = job["masks"]
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = wanted["threads"]
    options.max_image_size = wanted["max_size"]
    options.sift.max_num_features = wanted["max_features"]
    options.sift.estimate_affine_shape = options.sift.domain_size_pooling = wanted["affine"]
    names = [name for frame in job["frames"] for name in frame if name is not None]
    pycolmap.extract_features(
        path, job["pictures"], names, pycolmap.CameraMode.PER_IMAGE, reader, options, pycolmap.Device.cpu
    )
    camera_of = {name: index for frame in job["frames"] for index, name in enumerate(frame)}
    with pycolmap.Database.open(path) as database:
        for image in database.read_all_images():
            database.update_camera(_camera(job["cameras"][camera_of[image.name]], image.camera_id))


def _match(job: dict[str, Any], path: Path) -> None:
    with pycolmap.Database.open(path) as database:
        known = {image.name for image in database.read_all_images()}
    pairs = [(frame[a], frame[b]) for frame in job["frames"] for a, b in job["pairs"] if {frame[a], frame[b]} <= known]
    if not pairs:
        return
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = job["options"]["threads"]
    options.guided_matching = job["options"]["guided"]
    options.skip_geometric_verification = not options.guided_matching  # that comes when frames are merged
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = _pairs_file(job, pairs)
    pycolmap.match_image_pairs(path, options, pairing, _verification(), pycolmap.Device.cpu)


def _verification() -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = MIN_MATCHES
    options.detect_watermark = False
    options.ransac.random_seed = SEED
    return options


def _pairs_file(job: dict[str, Any], pairs: list[tuple[str, str]]) -> Path:
    path = Path(job["work"]) / "pairs.txt"
    path.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    return path


def _merge(job: dict[str, Any], by_picture: Path, by_camera: Path) -> list[tuple[str, str]]:
    """Write a database whose image C has camera C's keypoints of all frames; return the pairs that have matches."""
    with pycolmap.Database.open(by_picture) as source, pycolmap.Database.open(by_camera) as target:
        ids = {image.name: image.image_id for image in source.read_all_images()}
        lenses = {camera["lens"]: camera for camera in reversed(job["cameras"])}
        for lens, camera in lenses.items():
            target.write_camera(_camera(camera, lens + 1), use_camera_id=True)
            rig = pycolmap.Rig(rig_id=lens + 1)
            rig.add_ref_sensor(target.read_camera(lens + 1).sensor_id)
            target.write_rig(rig, use_rig_id=True)
        offsets = [_write_image(source, target, job, ids, index) for index in range(len(job["cameras"]))]
        pairs = []
        for a, b in job["pairs"]:
            parts = [np.empty((0, 2), np.uint32)]
            for frame, names in enumerate(job["frames"]):
                if names[a] in ids and names[b] in ids:
                    found = _matches(source, ids[names[a]], ids[names[b]], job["options"]["guided"])
                    parts.append(found + np.array([offsets[a][frame], offsets[b][frame]], np.uint32))
            matches = np.concatenate(parts)
            if len(matches) >= MIN_MATCHES:
                target.write_matches(a + 1, b + 1, matches)
                pairs.append((str(a), str(b)))
    return pairs


def _matches(database: pycolmap.Database, a: int, b: int, guided: bool) -> NDArray[np.uint32]:
    """All matches of two pictures, with those that guided matching has found beside them."""
    if not database.exists_matches(a, b):
        return np.empty((0, 2), np.uint32)
    matches = database.read_matches(a, b)
    if guided:
        matches = np.unique(np.concatenate([matches, database.read_two_view_geometry(a, b).inlier_matches]), axis=0)
    return matches


def _write_image(
    source: pycolmap.Database, target: pycolmap.Database, job: dict[str, Any], ids: dict[str, int], index: int
) -> list[int]:
    """Write one camera's image; return where the keypoints of each frame begin."""
    lens = job["cameras"][index]["lens"] + 1
    image = pycolmap.Image(name=str(index), camera_id=lens, image_id=index + 1)
    target.write_image(image, use_image_id=True)
    frame = pycolmap.Frame(frame_id=index + 1, rig_id=lens)
    frame.add_data_id(image.data_id)
    target.write_frame(frame, use_frame_id=True)
    parts, offsets = [np.empty((0, 2), np.float32)], []
    for names in job["frames"]:
        offsets.append(sum(map(len, parts)))
        if names[index] in ids:
            parts.append(source.read_keypoints(ids[names[index]])[:, :2])
    target.write_keypoints(index + 1, np.concatenate(parts))
    return offsets


def _points(model: pycolmap.Reconstruction) -> Arrays:
    points = list(model.points3D.values())
    tracks = [[(element.image_id - 1, element.point2D_idx) for element in point.track.elements] for point in points]
    observations = np.array([element for track in tracks for element in track], np.int64).reshape(-1, 2)
    return {
        "xyz": np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
        "error": np.array([point.error for point in points], np.float64),
        "offsets": np.cumsum([0, *map(len, tracks)]),
        "camera": observations[:, 0],
        "keypoint": observations[:, 1],
    }


def _poses(model: pycolmap.Reconstruction, job: dict[str, Any]) -> Arrays:
    count = len(job["cameras"])
    poses, registered = np.tile(np.eye(4), (count, 1, 1)), np.zeros(count, bool)
    params = np.array([camera["params"] for camera in job["cameras"]], np.float64)
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        poses[image_id - 1, :3] = image.cam_from_world().matrix()
        registered[image_id - 1] = True
        params[image_id - 1] = model.cameras[image.camera_id].params
    return {"poses": poses, "registered": registered, "params": params}


def _verified(job: dict[str, Any], path: Path) -> dict[tuple[int, int], NDArray[np.int64]]:
    """The matches of each pair of cameras that fit one geometry."""
    found = {}
    with pycolmap.Database.open(path) as database:
        for a, b in job["pairs"]:
            if database.exists_matches(a + 1, b + 1):
                matches = np.asarray(database.read_two_view_geometry(a + 1, b + 1).inlier_matches, np.int64)
                if len(matches):
                    found[a, b] = matches
    return found


def _finish(
    job: dict[str, Any], path: Path, matches: dict[tuple[int, int], NDArray[np.int64]], found: Arrays
) -> dict[str, Any]:
    """Write the result, with all keypoints and the matches; return how many points it holds."""
    arrays = found | {f"matches_{index}": value for index, value in enumerate(matches.values())}
    arrays["pairs"] = np.array(list(matches), np.int64).reshape(-1, 2)
    with pycolmap.Database.open(path) as database:
        for index in range(len(job["cameras"])):
            arrays[f"keypoints_{index}"] = database.read_keypoints(index + 1)[:, :2]
    with atomic_path(job["out"]) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)
    return {"points": len(arrays.get("xyz", ())), "pycolmap": pycolmap.__version__}
