"""When and where a mesh is refined: strategies, and the predictions that they go by."""

from difftetvr.fit.refinement.exchange import Exchange, Grow
from difftetvr.fit.refinement.star import Star
from difftetvr.fit.refinement.strategy import Moment, Refinement, Situation, Strategy

__all__ = ["Exchange", "Grow", "Moment", "Refinement", "Situation", "Star", "Strategy"]
