"""The encoder of detections: padding is nothing, order and number are something."""

import torch

from cadence.network.encoder import DetectionEncoder


def encoder() -> DetectionEncoder:
    torch.manual_seed(0)
    return DetectionEncoder(4, 16)


def rows(num: int = 5) -> torch.Tensor:
    return torch.randn(3, num, 4, generator=torch.Generator().manual_seed(1))


def test_padding_is_not_read() -> None:
    net, x = encoder(), rows()
    observed = torch.arange(5) < torch.tensor([[5], [2], [0]])
    plain = net(x, observed)
    other = torch.where(observed[..., None], x, torch.full_like(x, 1e3))
    torch.testing.assert_close(net(other, observed), plain, rtol=0, atol=0)
    wider = net(torch.cat([x, x], 1), torch.cat([observed, torch.zeros_like(observed)], 1))
    torch.testing.assert_close(wider, plain)
    torch.testing.assert_close(net(x[1:2, :2], observed[1:2, :2]), plain[1:2])


def test_no_detection_is_the_sentinel_alone() -> None:
    net = encoder()
    none = torch.zeros(3, 5, dtype=torch.bool)
    code = net(rows(), none)
    assert tuple(code.shape) == (3, 16)
    torch.testing.assert_close(code[0], code[2])
    code.sum().backward()
    assert net.sentinel.grad is not None and bool(net.sentinel.grad.any())


def test_order_counts() -> None:
    net, x = encoder(), rows()
    seen = torch.ones(3, 5, dtype=torch.bool)
    assert not torch.allclose(net(x, seen), net(x.flip(1), seen))
