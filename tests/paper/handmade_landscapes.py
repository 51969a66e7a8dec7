"""The landscapes of a tiny run whose every number can be worked out: two agents that are led up and to the right."""

import numpy as np

UNIT = 2.0  # raw length of a scaled unit
EPOCHS = (0, 1, 3)


def frame() -> dict[str, np.ndarray]:
    """A plane of 11 x 9 points, one raw unit apart, and two experts of four steps for each of two agents.

    Agent n's go from (1 + 5 n, 4) to (4 + 5 n, 4), the second 0.5 above the first.
    """
    steps = np.arange(4.0)
    first = np.stack([np.stack([1 + steps + 5 * n, np.full(4, 4.0)], axis=-1) for n in range(2)], axis=1)
    return {
        "landscape/x": np.arange(11, dtype=np.float32),
        "landscape/y": np.arange(9, dtype=np.float32),
        "landscape/unit": np.array([UNIT]),
        "landscape/expert": np.stack([first, first + np.array([0, 0.5])]).astype(np.float32),
    }


def linear(slope: float = 1.0, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Rewards (2, 9, 11) that rise with y, by `slope` per scaled unit, and their gradients; agent 1's are -1 lower."""
    y = np.repeat(np.arange(9.0)[:, None], 11, axis=1)
    reward = np.stack([offset + slope * y / UNIT, offset + slope * y / UNIT - 1])
    gradient = np.zeros((2, 9, 11, 2))
    gradient[..., 1] = slope
    return reward, gradient


def step(edge: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Rewards that are 0 below the row `edge` and 1 from there on; steep in that row alone."""
    reward = np.zeros((2, 9, 11))
    reward[:, edge:] = 1
    gradient = np.zeros((2, 9, 11, 2))
    gradient[:, edge, :, 1] = 4
    return reward, gradient


def rollouts(y: float) -> np.ndarray:
    """(3, 4, 2, 2) level ones at that height, a tenth apart."""
    made = np.stack([frame()["landscape/expert"][0] + np.array([0, k / 10]) for k in range(3)])
    made[..., 1] += y - 4
    return made.astype(np.float16)


def landscapes(field: tuple[np.ndarray, np.ndarray], epochs: tuple[int, ...] = EPOCHS) -> dict[str, np.ndarray]:
    """What a run stores that looks at the same field after each of these epochs; its policy rises by a unit each."""
    arrays = frame()
    for epoch in epochs:
        reward, gradient = field
        prefix = f"landscape/{epoch:04d}"
        arrays[f"{prefix}/reward"] = reward.astype(np.float16)
        arrays[f"{prefix}/gradient"] = gradient.astype(np.float16)
        arrays[f"{prefix}/rollouts"] = rollouts(1.0 + epoch)
    return arrays


def vector_field(behind: float) -> dict[str, np.ndarray]:
    """Gradients around a policy at y = 1 whose expert is at y = 4: straight up, but for a negative alpha turned to a
    cosine of `behind`.
    """
    alpha = np.arange(-8, 8) / 8
    current = rollouts(1.0)[:2].astype(np.float64)
    gradient = np.zeros((16, *current.shape))
    gradient[8:, ..., 1] = 2
    gradient[:8, ..., 1], gradient[:8, ..., 0] = 2 * behind, 2 * np.sqrt(1 - behind**2)
    expert = current + np.array([0, 3.0])
    made = {"alpha": alpha, "gradient": gradient.astype(np.float16)}
    made |= {"current": current.astype(np.float32), "expert": expert.astype(np.float32)}
    return {f"vector_field/{name}": values for name, values in made.items()}
