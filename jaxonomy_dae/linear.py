"""Linear operators and solvers: written out, dense, sparse; all of them are Lineax'."""

from .solve.linear import KLU as KLU
from .solve.linear import Dense as Dense
from .solve.linear import SparseLinearOperator as SparseLinearOperator
from .solve.linear import SparseMatrix as SparseMatrix
from .solve.linear import SparsePattern as SparsePattern
from .solve.linear import WrittenOut as WrittenOut
from .solve.linear import solve_sparse as solve_sparse
from .solve.linear import sparse_jacobian as sparse_jacobian
