"""Which seed a figure shows where it has room for one run of each group only."""

from collections.abc import Sequence


def typical_runs(groups: Sequence[Sequence[tuple[int, float]]]) -> list[int]:
    """Return the place of the run that is shown in each group of runs (seed, number); no group is empty.

    All groups show the same seed if they have one in common: the one whose numbers are closest to the medians of their
    groups, counted in ranks (the lower median of an even number; the lower of two such seeds). Otherwise each group
    shows its median.
    """
    ranked = [sorted(range(len(runs)), key=lambda i: (runs[i][1], runs[i][0])) for runs in groups]
    away = [_from_the_median(order) for order in ranked]
    common = set.intersection(*({seed for seed, _ in runs} for runs in groups))
    if not common:
        return [distances.index(0) for distances in away]

    def nearest(place: int, seed: int) -> int:
        return min((i for i, (own, _) in enumerate(groups[place]) if own == seed), key=away[place].__getitem__)

    def distance(seed: int) -> int:
        return sum(away[place][nearest(place, seed)] for place in range(len(groups)))

    chosen = min(sorted(common), key=distance)
    return [nearest(place, chosen) for place in range(len(groups))]


def _from_the_median(order: Sequence[int]) -> list[int]:
    """Return how many ranks each run is away from the lower median; `order` has the runs by rank."""
    middle = (len(order) - 1) // 2
    return [abs(order.index(i) - middle) for i in range(len(order))]
