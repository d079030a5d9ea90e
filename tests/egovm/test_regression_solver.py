"""The regression solver of A6: the paper's sizes, padding, samples without landmarks, and that it can learn."""

import math

import torch

from egovm.regression_solver import RegressionSolver


def test_it_has_the_papers_layers() -> None:
    solver = RegressionSolver()
    shapes = [tuple(p.shape[:2]) for name, p in solver.named_parameters() if p.dim() == 3]
    assert shapes == [(256, 256)] * 3 + [(1024, 256), (1024, 1024), (3, 1024)]


def drawn(samples: int, elements: int, channels: int = 8) -> torch.Tensor:
    return torch.randn(samples, elements, channels, generator=torch.Generator().manual_seed(1))


def test_padding_changes_nothing_in_training_and_evaluation() -> None:
    for train in (True, False):
        torch.manual_seed(0)
        solver, padded = RegressionSolver(8, 16).train(train), RegressionSolver(8, 16).train(train)
        padded.load_state_dict(solver.state_dict())
        x, valid = drawn(2, 5), torch.ones(2, 5) > 0
        more = torch.cat((x, torch.full((2, 3, 8), torch.nan)), 1)
        one = solver(x, valid)
        two = padded(more, torch.cat((valid, torch.zeros(2, 3) > 0), 1))
        assert torch.allclose(one.offset, two.offset, atol=1e-6)
        assert one.offset.abs().max() > 0
        for ours, theirs in zip(solver.buffers(), padded.buffers(), strict=True):
            assert torch.allclose(ours, theirs)


def test_without_landmarks_it_says_so() -> None:
    for train in (True, False):
        solver = RegressionSolver(8, 16).train(train)
        for x, valid in ((drawn(2, 0), torch.ones(2, 0) > 0), (drawn(2, 4), torch.zeros(2, 4) > 0)):
            found = solver(x, valid)
            assert not found.found.any()
            assert torch.equal(found.offset, torch.zeros(2, 3))
    single = torch.tensor([[True, False], [False, False]])
    found = RegressionSolver(8, 16)(drawn(2, 2).requires_grad_(), single)
    assert found.found.tolist() == [True, False]
    assert found.offset.isfinite().all()


def test_it_learns_what_embeddings_say() -> None:
    """Each embedding holds the offset plainly, with noise: what is left after training is small against its spread."""
    torch.manual_seed(2)
    solver = RegressionSolver(8, 32)
    optimizer = torch.optim.Adam(solver.parameters(), lr=3e-3)
    truth = (torch.rand(64, 3) * 2 - 1) * torch.tensor([3.0, 3.0, math.radians(3.0)])
    units = torch.tensor([1.0, 1.0, math.radians(1.0)])
    x = torch.cat((truth / units, torch.zeros(64, 5)), 1)[:, None] + 0.05 * torch.randn(64, 6, 8)
    valid = torch.rand(64, 6) < 0.8
    valid[:, 0] = True
    for _ in range(120):
        loss = ((solver(x, valid).offset - truth) / units).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert float(loss.detach()) < 0.3  # it starts at 1.5
