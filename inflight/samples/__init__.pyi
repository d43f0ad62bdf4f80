from .alignment import FIELD_ROLES, PlainSamples, Series, align, continuous_sign
from .derived import (
    PLAY_VERSION,
    ChannelFactor,
    DerivedChannel,
    base_channels,
    channel_product,
    derive_channel,
    parse_channel,
    slow_response,
)
from .interpolation import running_means
from .spin_folding import (
    FOLD_ORDER,
    FOLDING_SETTINGS,
    FOLDING_VERSION,
    Complex,
    Folding,
    fold_series,
    fold_spins,
)

__all__ = [
    "FIELD_ROLES",
    "FOLDING_SETTINGS",
    "FOLDING_VERSION",
    "FOLD_ORDER",
    "PLAY_VERSION",
    "ChannelFactor",
    "Complex",
    "DerivedChannel",
    "Folding",
    "PlainSamples",
    "Series",
    "align",
    "base_channels",
    "channel_product",
    "continuous_sign",
    "derive_channel",
    "fold_series",
    "fold_spins",
    "parse_channel",
    "running_means",
    "slow_response",
]
