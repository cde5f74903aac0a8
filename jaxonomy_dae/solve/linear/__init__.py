"""Linear operators and solvers: written out, dense, sparse; all of them are Lineax'."""

from .direct import KLU as KLU
from .direct import Dense as Dense
from .direct import WrittenOut as WrittenOut
from .operator import SparseLinearOperator as SparseLinearOperator
from .sparse import SparseMatrix as SparseMatrix
from .sparse import SparsePattern as SparsePattern
from .sparse import solve_sparse as solve_sparse
from .sparse import sparse_jacobian as sparse_jacobian
