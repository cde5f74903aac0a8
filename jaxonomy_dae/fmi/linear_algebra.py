"""Factorizations in C, which the code of `array_operations` calls."""


def _both(text: str) -> dict[str, str]:
    """A routine's text for both precisions, by name."""
    out = {}
    for tag, name, suffix in (("d", "double", ""), ("f", "float", "f")):
        code = text.replace("$T", name).replace("$S", suffix).replace("$G", tag)
        out[code.split("(")[0].split()[-1]] = code
    return out


ROUTINES: dict[str, str] = {
    # Gaussian elimination with partial pivoting, as LAPACK's getrf: L below the diagonal, U on and above it.
    **_both("""\
static void jx_lu_$G($T *a, int32_t *pivots, int32_t *order, int n, int m) {
  for (int i = 0; i < n; ++i) order[i] = i;
  for (int k = 0; k < n && k < m; ++k) {
    int best = k;
    for (int i = k + 1; i < n; ++i)
      if (fabs$S(a[i * m + k]) > fabs$S(a[best * m + k])) best = i;
    pivots[k] = best;
    if (best != k) {
      const int32_t o = order[k];
      order[k] = order[best];
      order[best] = o;
      for (int j = 0; j < m; ++j) {
        const $T x = a[k * m + j];
        a[k * m + j] = a[best * m + j];
        a[best * m + j] = x;
      }
    }
    if (a[k * m + k] == 0) continue;
    for (int i = k + 1; i < n; ++i) {
      const $T factor = a[i * m + k] / a[k * m + k];
      a[i * m + k] = factor;
      if (factor == 0) continue;
      for (int j = k + 1; j < m; ++j) a[i * m + j] -= factor * a[k * m + j];
    }
  }
}
"""),
    # a x = b or its transpose for `other` right-hand sides, whose entries are `step` apart, and `skip` from each other.
    **_both("""\
static void jx_triangular_$G(
    const $T *a, $T *b, int n, int other, int step, int skip, int lower, int turned, int unit) {
  for (int c = 0; c < other; ++c)
    for (int p = 0; p < n; ++p) {
      const int i = lower ? p : n - 1 - p;
      $T x = b[i * step + c * skip];
      for (int q = 0; q < p; ++q) {
        const int j = lower ? q : n - 1 - q;
        x -= (turned ? a[j * n + i] : a[i * n + j]) * b[j * step + c * skip];
      }
      b[i * step + c * skip] = unit ? x : x / a[i * n + i];
    }
}
"""),
    **_both("""\
static void jx_cholesky_$G($T *a, int n) {
  for (int j = 0; j < n; ++j) {
    for (int k = 0; k < j; ++k)
      for (int i = j; i < n; ++i) a[i * n + j] -= a[i * n + k] * a[j * n + k];
    const $T root = sqrt$S(a[j * n + j]);
    for (int i = j; i < n; ++i) a[i * n + j] /= root;
    for (int i = 0; i < j; ++i) a[i * n + j] = 0;
  }
}
"""),
    # Householder's reflections, as LAPACK's geqrf: v below the diagonal, with v[k] = 1.
    **_both("""\
static void jx_geqrf_$G($T *a, $T *taus, int n, int m) {
  for (int k = 0; k < n && k < m; ++k) {
    $T largest = 0, sum = 0;
    for (int i = k + 1; i < n; ++i)
      if (fabs$S(a[i * m + k]) > largest || a[i * m + k] != a[i * m + k]) largest = fabs$S(a[i * m + k]);
    taus[k] = 0;
    if (largest == 0) continue;
    if (fabs$S(a[k * m + k]) > largest) largest = fabs$S(a[k * m + k]);
    for (int i = k; i < n; ++i) {
      const $T x = a[i * m + k] / largest;
      sum += x * x;
    }
    const $T head = a[k * m + k], beta = head > 0 ? -largest * sqrt$S(sum) : largest * sqrt$S(sum);
    taus[k] = (beta - head) / beta;
    for (int i = k + 1; i < n; ++i) a[i * m + k] /= head - beta;
    a[k * m + k] = beta;
    for (int j = k + 1; j < m; ++j) {
      $T product = a[k * m + j];
      for (int i = k + 1; i < n; ++i) product += a[i * m + k] * a[i * m + j];
      product *= taus[k];
      a[k * m + j] -= product;
      for (int i = k + 1; i < n; ++i) a[i * m + j] -= product * a[i * m + k];
    }
  }
}
"""),
    # The first m columns of the product of these reflections, as LAPACK's orgqr.
    **_both("""\
static void jx_householder_$G(const $T *a, const $T *taus, $T *q, int n, int m, int count) {
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < m; ++j) q[i * m + j] = i == j;
  for (int k = count - 1; k >= 0; --k)
    for (int j = 0; j < m; ++j) {
      $T product = q[k * m + j];
      for (int i = k + 1; i < n; ++i) product += a[i * m + k] * q[i * m + j];
      product *= taus[k];
      q[k * m + j] -= product;
      for (int i = k + 1; i < n; ++i) q[i * m + j] -= product * a[i * m + k];
    }
}
"""),
}
