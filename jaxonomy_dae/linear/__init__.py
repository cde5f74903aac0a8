"""Linear operators and solvers: written out, dense, sparse; all of them are Lineax'."""

from .direct import KLU as KLU
from .direct import Dense as Dense
from .direct import WrittenOut as WrittenOut
from .operator import SparseLinearOperator as SparseLinearOperator
from .sparse import SparsePattern as SparsePattern
