"""Pictures agree with the projection: marks, depth, flow, edges, shutter."""

import numpy as np
import pytest

from vioframe.checks import Array
from vioframe.data.simulator import CameraSettings, Degradations, SimulatedDataset
from vioframe.data.simulator.render import Renderer
from vioframe.data.simulator.texture import LEVELS, Atlas, Texture, fractal_noise
from vioframe.data.simulator.world import Skin, World, WorldPlan
from vioframe.geometry import camera as camera_models
from vioframe.geometry import se3, so3
from vioframe.types import Camera

WALL_X = 4.0
MARK_M = 0.012
PPM = 250
ROWS = np.arange(0.4, 3.7, 0.25)
COLUMNS = np.arange(-2.6, 2.7, 0.25)
LOW, HIGH = np.array([-4.0, -3.0, 0.0]), np.array([WALL_X, 3.0, 4.0])

PINHOLE = CameraSettings(kit="euroc", model="pinhole").build("euroc")[0]
RADTAN = CameraSettings(kit="euroc").build("euroc")[0]
EQUIDISTANT = CameraSettings(kit="tumvi", size_px=(640, 512), intrinsics_px=(300.0, 301.0, 318.3, 254.1)).build(
    "euroc"
)[0]
CAMERAS = {"pinhole": PINHOLE, "radtan": RADTAN, "equidistant": EQUIDISTANT}


def wall_of_marks() -> tuple[World, Atlas, Array]:
    """A dark room with Gaussian marks on the wall ahead, and their positions (M, 3)."""
    y = (np.arange(6 * PPM) + 0.5) / PPM - 3.0
    z = 4.0 - (np.arange(4 * PPM) + 0.5) / PPM
    across = np.exp(-((y[:, None] - COLUMNS) ** 2) / (2 * MARK_M**2)).sum(axis=1)
    down = np.exp(-((z[:, None] - ROWS) ** 2) / (2 * MARK_M**2)).sum(axis=1)
    image = np.clip(230 * down[:, None] * across[None, :], 0, 255).astype(np.uint8)
    plan = WorldPlan()
    marks = plan.add_texture(Texture(image=image, size_m=(6.0, 4.0)))
    dark = plan.add_texture(Texture(image=np.zeros((16, 16), np.uint8), size_m=(1.0, 1.0)))
    skins = [Skin(texture=dark, origin=(0.0, 0.0))] * 6
    skins[1] = Skin(texture=marks, origin=(-3.0, 4.0))
    plan.add_solid(LOW, HIGH, skins)
    points = np.array([[WALL_X, y, z] for y in COLUMNS for z in ROWS])
    return World(plan), Atlas(plan.textures), points


def centroid_errors(grey: np.ndarray, camera: Camera, T_world_cam: Array, points: Array) -> Array:
    """Centroid minus predicted pixel (K, 2) of the marks that are well inside and of a size to measure."""
    local = se3.transform(se3.inverse(T_world_cam), points)
    pixels, visible = camera_models.project(camera, local)
    errors = []
    for pixel, depth in zip(pixels[visible], local[visible, 2], strict=True):
        sigma = MARK_M * camera.intrinsics_px[0] / depth
        reach = int(np.ceil(4.5 * sigma)) + 1
        x, y = np.round(pixel).astype(int)
        width, height = camera.size_px
        if sigma > 3.0 or not (reach <= x < width - reach and reach <= y < height - reach):
            continue
        window = grey[y - reach : y + reach + 1, x - reach : x + reach + 1].astype(float)
        if window.sum() < 100.0:
            continue
        rows, columns = np.mgrid[y - reach : y + reach + 1, x - reach : x + reach + 1]
        centre = np.array([(columns * window).sum(), (rows * window).sum()]) / window.sum()
        errors.append(centre - pixel)
    return np.array(errors)


@pytest.mark.parametrize("model", list(CAMERAS))
def test_marks_are_drawn_where_the_projection_says(model: str) -> None:
    world, atlas, points = wall_of_marks()
    camera = CAMERAS[model]
    renderer = Renderer(world, atlas, camera)
    everything = []
    for position, rotation in (
        ((0.5, 0.2, 1.9), (0.0, 0.0, 0.0)),
        ((-1.0, 0.3, 2.0), (0.1, 0.05, 0.3)),
        ((1.5, -1.0, 1.0), (0.02, -0.2, 0.4)),
    ):
        T_world_cam = se3.from_parts(so3.exp(np.array(rotation)), np.array(position)) @ camera.T_body_cam
        grey = renderer.render(T_world_cam).grey
        everything.append(centroid_errors(grey, camera, T_world_cam, points))
    errors = np.concatenate(everything)
    assert len(errors) > 150
    assert np.linalg.norm(errors, axis=1).max() < 0.1
    assert np.abs(errors.mean(axis=0)).max() < 0.02


def test_marks_roll_with_the_shutter() -> None:
    """Each mark is seen from the pose of its own row."""
    world, atlas, points = wall_of_marks()
    height = RADTAN.size_px[1]
    turn = np.linspace(0.0, 0.03, height)
    poses = np.stack(
        [
            se3.from_parts(so3.exp(np.array([0.0, 0.0, a])), np.array([0.0, 3.0 * a, 2.0])) @ RADTAN.T_body_cam
            for a in turn
        ]
    )
    grey = Renderer(world, atlas, RADTAN).render(poses).grey
    local = se3.transform(se3.inverse(poses[height // 2]), points)
    rows = camera_models.project(RADTAN, local)[0][:, 1]
    errors = []
    for point, guess in zip(points, rows, strict=True):
        row = guess
        for _ in range(4):
            pose = poses[int(np.clip(np.round(row), 0, height - 1))]
            pixel, visible = camera_models.project(RADTAN, se3.transform(se3.inverse(pose), point[None]))
            row = pixel[0, 1]
        if visible[0]:
            errors.append(centroid_errors(grey, RADTAN, pose, point[None]))
    found = np.concatenate([e for e in errors if len(e)])
    assert len(found) > 60
    assert np.linalg.norm(found, axis=1).max() < 0.12


def test_depth_is_exact() -> None:
    world, atlas, _ = wall_of_marks()
    T_world_cam = se3.from_parts(so3.exp(np.array([0.1, 0.2, 0.3])), np.array([0.3, 0.2, 1.7])) @ RADTAN.T_body_cam
    view = Renderer(world, atlas, RADTAN).render(T_world_cam, smooth_edges=False)
    grid = np.stack(np.meshgrid(np.arange(752.0), np.arange(480.0)), axis=-1)
    ideal = camera_models.normalised(RADTAN, grid)
    points = np.concatenate([ideal, np.ones((480, 752, 1))], axis=-1) * view.depth[..., None]
    on_wall = se3.transform(T_world_cam, points.reshape(-1, 3))
    gap = np.minimum(np.abs(on_wall - LOW), np.abs(on_wall - HIGH)).min(axis=1)
    assert gap.max() < 1e-4
    assert np.all(on_wall > LOW - 1e-4) and np.all(on_wall < HIGH + 1e-4)


def box_room() -> tuple[World, Atlas]:
    """A dark room with a bright box and a grey one behind it."""
    plan = WorldPlan()
    tones = [
        plan.add_texture(Texture(image=np.full((16, 16), tone, np.uint8), size_m=(1.0, 1.0))) for tone in (0, 200, 100)
    ]
    plan.add_solid(LOW, HIGH, [Skin(texture=tones[0], origin=(0.0, 0.0))] * 6)
    # The farther one first: order must not matter.
    plan.add_solid(
        np.array([3.0, -1.0, 1.0]), np.array([3.5, 1.0, 3.0]), [Skin(texture=tones[2], origin=(0.0, 0.0))] * 6
    )
    plan.add_solid(
        np.array([2.0, -0.5, 1.5]), np.array([2.5, 0.5, 2.5]), [Skin(texture=tones[1], origin=(0.0, 0.0))] * 6
    )
    return World(plan), Atlas(plan.textures)


def test_the_nearer_box_hides_the_farther() -> None:
    world, atlas = box_room()
    renderer = Renderer(world, atlas, PINHOLE)
    T_world_cam = se3.from_parts(np.eye(3), np.array([0.0, 0.0, 2.0])) @ PINHOLE.T_body_cam
    T_world_cam[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T_world_cam[:3, 3] = [0.0, 0.0, 2.0]
    view = renderer.render(T_world_cam)
    fx, _, cx, cy = PINHOLE.intrinsics_px
    assert view.depth[round(cy), round(cx)] == pytest.approx(2.0, abs=1e-5)
    beside = round(cx - fx * 0.8 / 3.0)
    assert view.depth[round(cy), beside] == pytest.approx(3.0, abs=1e-5)
    # The area of the near face, with soft edges, is that of its projection.
    bright = view.grey[:, : round(cx)] / renderer._falloff[:, : round(cx)]
    middle = bright[round(cy)]
    share = np.clip((middle - 100.0) / 100.0, 0.0, 1.0).sum()
    assert share == pytest.approx(fx * 0.5 / 2.0 + (round(cx) - 0.5 - cx), abs=0.3)


def test_edges_are_smooth_not_stepped() -> None:
    """Along a slanted edge the position of half brightness moves evenly."""
    world, atlas = box_room()
    camera = PINHOLE
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]) @ so3.exp(
        np.array([0.0, 0.0, 0.1])
    )
    T_world_cam[:3, 3] = [0.0, 0.0, 2.0]
    renderer = Renderer(world, atlas, camera)
    rows = np.arange(210, 290)
    spread = []
    for smooth in (True, False):
        grey = renderer.render(T_world_cam, smooth_edges=smooth).grey / renderer._falloff
        share = np.clip((grey[rows, 100:350] - 100.0) / 100.0, 0.0, 1.0).sum(axis=1)
        line = np.polyfit(rows, share, 1)
        spread.append(np.std(share - np.polyval(line, rows)))
    assert spread[0] < 0.12
    assert spread[1] > 2.0 * spread[0]


def test_flow_agrees_with_depth_and_motion() -> None:
    settings = CameraSettings(size_px=(188, 120))
    recording = SimulatedDataset(seed=2, duration_s=8.0, camera=settings).open("walk-2")
    imager, camera = recording.imager, recording.rig.cameras[0]
    flow, seen = imager.flow(5.0, 5.1)
    assert seen.mean() > 0.7
    depth = imager.depth(5.0)
    T_now, T_later = (recording.motion.evaluate(t).T_world_body @ camera.T_body_cam for t in (5.0, 5.1))
    rng = np.random.default_rng(0)
    for y, x in rng.permutation(np.argwhere(seen))[:50]:
        bearing = camera_models.bearings(camera, np.array([float(x), float(y)]))
        world_point = se3.transform(T_now, (bearing * depth[y, x] / bearing[2])[None])
        pixel, _ = camera_models.project(camera, se3.transform(se3.inverse(T_later), world_point))
        np.testing.assert_allclose(flow[y, x], pixel[0] - [x, y], atol=1e-3)
    # What is seen in both frames looks the same in both.
    first, second = imager.view(5.0).grey, imager.view(5.1).grey
    ys, xs = np.nonzero(seen)
    there = np.round(np.stack([xs, ys], axis=-1) + flow[seen]).astype(int)
    inside = (there[:, 0] < 188) & (there[:, 1] < 120) & (there >= 0).all(axis=1)
    change = np.abs(first[ys[inside], xs[inside]] - second[there[inside, 1], there[inside, 0]])
    assert np.median(change) < 5.0


def test_texture_copies_keep_the_mean_and_the_place() -> None:
    rng = np.random.default_rng(0)
    image = np.clip(128 + 40 * fractal_noise(rng, (96, 160), 24.0, 4), 0, 255).astype(np.uint8)
    atlas = Atlas([Texture(image=image, size_m=(1.6, 0.96))])
    for level in range(LEVELS):
        x, y = int(atlas.left[level]), int(atlas.top[level])
        width, height = int(atlas.width[level]), int(atlas.height[level])
        copy = atlas.image[y : y + height, x : x + width].astype(float)
        assert copy.mean() == pytest.approx(image.mean(), abs=1.5)
        # Beyond the border comes the opposite one.
        np.testing.assert_array_equal(atlas.image[y : y + height, x + width], copy[:, 0].astype(np.uint8))
    assert atlas.texels_per_metre[0] == pytest.approx(100.0)


def test_noise_repeats_at_its_borders() -> None:
    field = fractal_noise(np.random.default_rng(1), (120, 200), 40.0, 3)
    inner = np.abs(np.diff(field, axis=1)).mean()
    assert np.abs(field[:, 0] - field[:, -1]).mean() < 2.0 * inner
    assert np.std(field) == pytest.approx(1.0, abs=0.5)


def test_far_texture_does_not_alias() -> None:
    """Black and white stripes far finer than a pixel come out as an even grey."""
    stripes = np.zeros((256, 256), np.uint8)
    stripes[:, ::2] = 255
    plan = WorldPlan()
    fine = plan.add_texture(Texture(image=stripes, size_m=(0.256, 0.256)))
    plan.add_solid(LOW, HIGH, [Skin(texture=fine, origin=(0.0, 0.0))] * 6)
    renderer = Renderer(World(plan), Atlas(plan.textures), PINHOLE)
    T_world_cam = se3.from_parts(np.eye(3), np.array([-3.5, 0.0, 2.0])) @ PINHOLE.T_body_cam
    grey = renderer.render(T_world_cam).grey / renderer._falloff
    assert np.std(grey[200:280, 300:440]) < 3.0


def test_a_fisheye_is_blind_beyond_its_plane() -> None:
    wide = CameraSettings(kit="tumvi").build("euroc")[0]
    world, atlas, _ = wall_of_marks()
    view = Renderer(world, atlas, wide).render(se3.from_parts(np.eye(3), np.array([0.0, 0.0, 2.0])) @ wide.T_body_cam)
    assert view.depth[256, 254] > 0.0
    assert view.depth[0, 0] == 0.0 and view.grey[0, 0] == 0.0
    assert np.isfinite(view.grey).all()


def frames(degradations: Degradations, times: list[float], sequence: str = "walk") -> list[np.ndarray]:
    settings = CameraSettings(size_px=(376, 240), noise_dn=1.0)
    recording = SimulatedDataset(sequence=sequence, duration_s=10.0, camera=settings, degradations=degradations).open(
        f"{sequence}-0"
    )
    return [recording.imager.images(t)[0].astype(float) for t in times]


def sharpness(image: np.ndarray) -> float:
    return float(np.abs(np.diff(image, axis=1)).mean())


def test_degradations_do_what_they_say() -> None:
    times = [5.0, 6.0, 7.0]
    clear = frames(Degradations(), times)
    ramped = frames(Degradations(exposure_ramp=1.0, exposure_period_s=8.0), times)
    # sin(2π·6/8) = −1: half the light.
    assert ramped[1].mean() == pytest.approx(0.5 * clear[1].mean(), rel=0.03)
    flickering = frames(Degradations(flicker=0.2), times)
    ratios = [a.mean() / b.mean() for a, b in zip(flickering, clear, strict=True)]
    assert np.std(ratios) > 0.02
    blurred = frames(Degradations(motion_blur_s=0.04), times)
    assert sharpness(blurred[0]) < 0.85 * sharpness(clear[0])
    assert blurred[0].mean() == pytest.approx(clear[0].mean(), rel=0.03)
    bare = frames(Degradations(low_texture=0.8), times)
    assert sharpness(bare[0]) < 0.7 * sharpness(clear[0])
    dark = frames(Degradations(low_light=0.9), times)
    assert dark[0].mean() == pytest.approx(0.316 * clear[0].mean(), rel=0.1)
    noise_of = [
        float(np.median(np.abs(image[:, 2:] - 2 * image[:, 1:-1] + image[:, :-2]))) for image in (clear[0], dark[0])
    ]
    assert noise_of[1] > 2.0 * noise_of[0]


def test_blur_is_the_mean_over_the_exposure_whatever_the_motion() -> None:
    settings = CameraSettings(size_px=(376, 240), noise_dn=0.0)

    def opened(blur_s: float):  # type: ignore[no-untyped-def]
        spoilt = Degradations(motion_blur_s=blur_s)
        dataset = SimulatedDataset(sequence="walk", duration_s=10.0, camera=settings, degradations=spoilt)
        return dataset.open("walk-0").imager

    clear, blurred = opened(0.0), opened(0.04)
    # At rest there is nothing to blur.
    np.testing.assert_array_equal(blurred.images(1.0)[0], clear.images(1.0)[0])
    for t_s in (5.0, 7.0):
        dense = np.mean([clear.view(t_s + offset).grey for offset in np.linspace(-0.0195, 0.0195, 40)], axis=0)
        error = np.abs(blurred.images(t_s)[0].astype(float) - np.clip(dense, 0.0, 255.0))
        assert np.mean(error) < 1.0 and np.percentile(error, 99) < 6.0


def test_moving_objects_move_while_the_camera_stands() -> None:
    # The first two seconds are at rest; only what moves by itself can change the picture.
    spoilt = Degradations(moving_objects=6)
    seeds = []
    for sequence in ("walk", "standing"):
        still = frames(Degradations(), [0.0, 1.0], sequence)
        moving = frames(spoilt, [0.0, 1.0], sequence)
        assert np.mean(np.abs(still[1] - still[0]) > 12.0) < 0.001
        seeds.append(np.mean(np.abs(moving[1] - moving[0]) > 12.0))
    assert max(seeds) > 0.002


@pytest.mark.parametrize(
    ("option", "value"),
    [("flicker", -1.0), ("low_light", 1.0), ("motion_blur_s", -0.1), ("dropped_frames", 1.5), ("drop_length", 0.5),
     ("exposure_period_s", 0.0), ("moving_objects", -1)],
)  # fmt: skip
def test_wrong_degradations_are_refused_by_name(option: str, value: float) -> None:
    from vioframe.errors import ConfigError

    with pytest.raises(ConfigError, match=option):
        Degradations(**{option: value})  # type: ignore[arg-type]
