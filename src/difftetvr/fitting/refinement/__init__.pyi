from . import exchange as exchange
from . import exchange_round as exchange_round
from . import gains as gains
from . import star as star
from . import strategy as strategy
from .exchange import Exchange as Exchange
from .exchange import Grow as Grow
from .star import Star as Star
from .strategy import EmptySpace as EmptySpace
from .strategy import Moment as Moment
from .strategy import Refinement as Refinement
from .strategy import Situation as Situation
from .strategy import Strategy as Strategy

__all__ = ["EmptySpace", "Exchange", "Grow", "Moment", "Refinement", "Situation", "Star", "Strategy"]
