"""The user's response: inputs, calls, failures and storage."""

from prbayes.response.budget import BudgetError, Cost
from prbayes.response.by_specimen import by_specimen
from prbayes.response.condition import condition
from prbayes.response.discrepancy import Additive, Multiplicative, Smooth
from prbayes.response.failures import Abort, Replace, ResponseError, Retry
from prbayes.response.inputs import group
from prbayes.response.stochastic import Stochastic
from prbayes.response.store import Store, StoreError

__all__ = [
    "Abort",
    "Additive",
    "BudgetError",
    "Cost",
    "Multiplicative",
    "Replace",
    "ResponseError",
    "Retry",
    "Smooth",
    "Stochastic",
    "Store",
    "StoreError",
    "by_specimen",
    "condition",
    "group",
]
