"""From the options of a project to how its survey is adjusted."""

from adjust.adjustment import AdjustOptions
from adjust.pair_screen import PairOptions
from adjust.statistics.cleaned import CleanOptions
from survey.files import AdjustmentOptions


def clean_options(options: AdjustmentOptions) -> CleanOptions:
    """What ``survey.toml`` says under [adjustment]."""
    how = AdjustOptions(options.alpha, options.reject_blocks, options.reject_points)
    return CleanOptions(PairOptions(options.reject_pairs, how), options.variance_components)
