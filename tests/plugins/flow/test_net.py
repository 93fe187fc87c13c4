"""The network against classical TV-L1, numerical gradients and what its shape promises."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

torch = pytest.importorskip("torch", reason="torch is not installed (pip install 'vioframe[learn]')")

from vioframe_flow.net import TvNet, photometric_loss, split_pairs  # noqa: E402


def textured(seed: int, shape: tuple[int, int], octaves: tuple[int, ...] = (3, 6, 12)) -> np.ndarray:
    """A smooth random image (H, W), 0 … 255."""
    random = np.random.default_rng(seed)
    height, width = shape
    image = np.zeros(shape)
    for size in octaves:
        coarse = random.standard_normal((height // size + 4, width // size + 4))
        rows, columns = np.mgrid[:height, :width] / size + 1.0
        image += size**0.5 * map_coordinates(coarse, [rows, columns], order=3)
    return 255.0 * (image - image.min()) / np.ptp(image)


def shifted(image: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """The image (H, W) after its content has moved: what was at x is at x + flow[x]."""
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]].astype(float)
    from_rows, from_columns = rows, columns
    for _ in range(10):
        moved = [map_coordinates(flow[..., k], [from_rows, from_columns], order=1, mode="nearest") for k in (0, 1)]
        from_rows, from_columns = rows - moved[1], columns - moved[0]
    return map_coordinates(image, [from_rows, from_columns], order=3, mode="nearest")


def tensors(*images: np.ndarray, dtype=None) -> list:
    return [torch.from_numpy(image)[None, None].to(dtype or torch.float64) for image in images]


def classical(first, second, *, warps, iterations, tau=0.25, weight=0.15, theta=0.3):
    """TV-L1 of one scale as in Zach, Pock & Bischof 2007 and Chambolle 2004, written with loops and cases."""
    height, width = first.shape
    rows, columns = np.mgrid[:height, :width].astype(float)
    slopes = np.gradient(second)
    u = np.zeros((2, height, width))
    p = np.zeros((2, 2, height, width))
    for _ in range(warps):
        places = [rows + u[1], columns + u[0]]
        warped, gy, gx = (map_coordinates(a, places, order=1, mode="nearest") for a in (second, *slopes))
        inside = (places[0] >= 0) & (places[0] <= height - 1) & (places[1] >= 0) & (places[1] <= width - 1)
        gx, gy = gx * inside, gy * inside
        norm = gx**2 + gy**2
        constant = warped - first - gx * u[0] - gy * u[1]
        for _ in range(iterations):
            rho = constant + gx * u[0] + gy * u[1]
            with np.errstate(divide="ignore", invalid="ignore"):
                factor = np.select(
                    [rho < -weight * theta * norm, rho > weight * theta * norm, norm > 1e-10],
                    [weight * theta, -weight * theta, -rho / norm],
                    0.0,
                )
            v = u + factor * np.stack([gx, gy])
            for c in range(2):
                divergence = np.zeros((height, width))
                divergence[:, 0] += p[c, 0][:, 0]
                divergence[:, 1:] += p[c, 0][:, 1:] - p[c, 0][:, :-1]
                divergence[0] += p[c, 1][0]
                divergence[1:] += p[c, 1][1:] - p[c, 1][:-1]
                u[c] = v[c] + theta * divergence
                along = np.zeros((2, height, width))
                along[0][:, :-1] = u[c][:, 1:] - u[c][:, :-1]
                along[1][:-1] = u[c][1:] - u[c][:-1]
                p[c] = (p[c] + tau / theta * along) / (1 + tau / theta * np.hypot(*along))
    return np.moveaxis(u, 0, -1)


def flow_of(net, first, second) -> np.ndarray:
    with torch.no_grad():
        return net.double().solve(*tensors(first, second))[0].permute(1, 2, 0).numpy()


@pytest.mark.parametrize("settings", [(1, 1), (1, 30), (3, 10)], ids=str)
def test_untrained_it_is_classical_tvl1(settings: tuple[int, int]) -> None:
    warps, iterations = settings
    first = textured(1, (40, 56))
    rows, columns = np.mgrid[:40, :56]
    truth = np.stack([1.2 + 0.5 * np.sin(rows / 15.0), -0.6 * np.cos(columns / 20.0)], axis=-1)
    second = shifted(first, truth)
    net = TvNet(warps=warps, iterations=iterations, max_scales=1)
    wanted = classical(first, second, warps=warps, iterations=iterations)
    np.testing.assert_allclose(flow_of(net, first, second), wanted, atol=2e-6)


def test_it_finds_a_known_smooth_motion() -> None:
    first = textured(2, (96, 128), (4, 8, 16, 32))
    rows, columns = np.mgrid[:96, :128]
    truth = np.stack([6.0 + 2.0 * np.sin(rows / 30.0), -4.0 * np.cos(columns / 40.0)], axis=-1)
    error = np.linalg.norm(flow_of(TvNet(iterations=20), first, shifted(first, truth)) - truth, axis=-1)
    inner = error[12:-12, 12:-12]
    assert np.median(inner) < 0.1
    assert np.percentile(inner, 95) < 0.5


def test_constants_mean_what_they_say() -> None:
    """A heavier weight makes the second image, followed back, more like the first, at the price of a rougher flow."""
    first = textured(3, (48, 64))
    rows, columns = np.mgrid[:48, :64].astype(float)
    second = shifted(first, np.stack([1.5 * np.sin(rows / 4.0), np.cos(columns / 5.0)], axis=-1))
    misfits, roughnesses = [], []
    for weight in (0.001, 0.1):
        flow = flow_of(TvNet(data_weight=weight, iterations=60), first, second)
        followed = map_coordinates(second, [rows + flow[..., 1], columns + flow[..., 0]], order=1, mode="nearest")
        misfits.append(np.abs(followed - first).mean())
        roughnesses.append(np.abs(np.diff(flow, axis=0)).mean())
    assert misfits[0] > 2.0 * misfits[1]
    assert 2.0 * roughnesses[0] < roughnesses[1]


@pytest.mark.parametrize("size", [(16, 16), (17, 33), (5, 90), (1, 8), (64, 48)], ids=str)
def test_any_size_goes_in_and_comes_out(size: tuple[int, int]) -> None:
    net = TvNet()
    first, second = (torch.rand(2, 1, *size) for _ in range(2))
    with torch.no_grad():
        flow = net(first, second)
    assert flow.shape == (2, 2, *size)
    assert torch.isfinite(flow).all()


def test_scales_follow_the_diagonal() -> None:
    assert TvNet(max_scales=20).scales(256, 512) == 1 + int(np.log2(np.hypot(256, 512) / 4))
    assert TvNet(max_scales=3).scales(256, 512) == 3
    assert TvNet().scales(1, 1) == 1


def test_a_batch_is_its_pairs_one_by_one() -> None:
    net = TvNet(iterations=3)
    first, second = (torch.rand(3, 1, 32, 40) for _ in range(2))
    # Each pair is stretched by its own range.
    second = second * torch.tensor([1.0, 0.3, 5.0]).view(3, 1, 1, 1)
    with torch.no_grad():
        together = net(first, second)
        alone = torch.cat([net(a[None], b[None]) for a, b in zip(first, second, strict=True)])
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=0)


def test_range_and_colour_of_the_images_do_not_matter() -> None:
    net = TvNet(iterations=3).double()
    first, second = tensors(textured(4, (32, 40)), textured(5, (32, 40)))
    with torch.no_grad():
        flow = net(first, second)
        torch.testing.assert_close(net(first / 255, second / 255), flow, atol=1e-8, rtol=0)
        grey = [image.expand(-1, 3, -1, -1) for image in (first, second)]
        torch.testing.assert_close(net(*grey), flow, atol=1e-6, rtol=0)


def test_nothing_to_see_is_no_motion_and_no_trouble() -> None:
    net = TvNet(learn_constants=True)
    blank = torch.full((1, 1, 24, 32), 7.0)
    flow = net(blank, blank)
    assert flow.abs().max() == 0.0
    first, second = net.prepare(blank, blank)
    photometric_loss(first, second, flow).backward()
    assert all(torch.isfinite(p.grad).all() for p in net.parameters() if p.grad is not None)


def test_gradients_are_those_of_finite_differences() -> None:
    torch.manual_seed(0)
    net = TvNet(warps=2, iterations=2, max_scales=2, learn_constants=True, start_grid=(2, 2)).double()
    first = textured(6, (10, 12))
    pair = tensors(first, shifted(first, np.full((10, 12, 2), 0.7)))
    names = list(dict(net.named_parameters()))
    values = [p.detach() + 0.05 * torch.randn_like(p) for p in net.parameters()]

    def run(*parameters):
        return torch.func.functional_call(net, dict(zip(names, parameters, strict=True)), tuple(pair))

    assert set(names) == {"gradient_kernels", "divergence_kernels", "log_constants", "start"}
    assert torch.autograd.gradcheck(run, [v.requires_grad_() for v in values], eps=1e-7, atol=1e-4, rtol=1e-3)


def test_gradients_reach_the_images() -> None:
    net = TvNet(warps=1, iterations=2, max_scales=1).double()
    first = textured(7, (8, 9))
    pair = [image.requires_grad_() for image in tensors(first, shifted(first, np.full((8, 9, 2), 0.4)))]
    assert torch.autograd.gradcheck(lambda a, b: net.solve(a, b), pair, eps=1e-6, atol=1e-4, rtol=1e-3)


def test_training_without_truth_lowers_the_energy() -> None:
    torch.manual_seed(0)
    first = textured(8, (32, 48))
    pair = tensors(first, shifted(first, np.full((32, 48, 2), 1.5)), dtype=torch.float32)
    net = TvNet(warps=1, iterations=3, max_scales=2, learn_constants=True, start_grid=(2, 3))
    optimiser = torch.optim.Adam(net.parameters(), lr=0.02)
    losses = []
    for _ in range(25):
        prepared = net.prepare(*pair)
        loss = photometric_loss(*prepared, net.solve(*prepared))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.7 * losses[0]
    assert all(torch.isfinite(p).all() for p in net.parameters())


def test_a_learned_start_is_stretched_over_any_image() -> None:
    net = TvNet(warps=1, iterations=1, max_scales=1, start_grid=(1, 1))
    with torch.no_grad():
        net.start.copy_(torch.tensor([0.1, -0.25]).view(1, 2, 1, 1))
        for height, width in ((20, 40), (32, 16)):
            # Blank images say nothing, so the start is kept; smoothing has nothing to smooth.
            flow = net(torch.ones(1, 1, height, width), torch.ones(1, 1, height, width))
            torch.testing.assert_close(flow[0, :, 3, 5], torch.tensor([0.1 * width, -0.25 * height]))


def test_pairs_are_split_in_order() -> None:
    images = torch.arange(2 * 4, dtype=torch.float32).view(2, 4, 1, 1, 1).expand(2, 4, 1, 6, 8)
    first, second = split_pairs(images, None)
    assert first[:, 0, 0, 0].tolist() == [0, 1, 2, 4, 5, 6]
    assert second[:, 0, 0, 0].tolist() == [1, 2, 3, 5, 6, 7]
    assert split_pairs(images, (4, 3))[0].shape == (6, 1, 3, 4)
