"""Inner loops of the sparse solvers, for one patch at a time.

`atoms` is the sensed dictionary Psi D, one atom a row: (atom, measurement) float32, C-contiguous.
All but the smallest part of the work is one pass over it per step, which correlates every atom
with a vector and sums the atoms that stay in use: 4 atoms measurements operations in all, and
that many bytes, which stay in a core's second-level cache (5,000 atoms of 81 measurements: 1.6 MB).

Kernels release the interpreter's lock, so that patches are solved in threads.
"""

from __future__ import annotations

import numpy as np

from emmc_rig.model.compiling import njit

NONE = -1
BINS = 256
"""Of the histogram by which a working set is cut."""
FIRST_STEPS = 20
INNER_SHARE = 0.5
DEPENDENT = 1e-3
"""An atom of which the chosen ones explain all but this share of its norm adds nothing."""
DARKEST = 1e-6
"""Sensed atoms weaker than this, against the strongest, are dark and never chosen."""
FRESH = 0.7
"""LARS: once the level fell to this share, correlations are computed anew: they are 32 bits."""
NEVER = 1e30
POWER_STEPS = 40
POWER_MARGIN = 1.02


@njit(cache=True, fastmath=True, nogil=True)
def gram(atoms, out):
    """Set out (measurement, measurement) to the sum of the atoms' outer products."""
    count, length = atoms.shape
    out[:] = 0
    even = count - count % 4
    for j in range(0, even, 4):
        a, b, c, d = atoms[j], atoms[j + 1], atoms[j + 2], atoms[j + 3]
        for i in range(length):
            ai, bi, ci, di = a[i], b[i], c[i], d[i]
            row = out[i]
            for k in range(i + 1):
                row[k] += ai * a[k] + bi * b[k] + ci * c[k] + di * d[k]
    for j in range(even, count):
        a = atoms[j]
        for i in range(length):
            ai = a[i]
            row = out[i]
            for k in range(i + 1):
                row[k] += ai * a[k]
    for i in range(length):
        for k in range(i):
            out[k, i] = out[i, k]


@njit(cache=True, fastmath=True, nogil=True)
def _pairwise(atoms, out):
    """Set out (atom, atom) to the atoms' inner products."""
    count, length = atoms.shape
    for i in range(count):
        a = atoms[i]
        for j in range(i + 1):
            b = atoms[j]
            total = np.float32(0)
            for k in range(length):
                total += a[k] * b[k]
            out[i, j] = total
            out[j, i] = total


@njit(cache=True, fastmath=True, nogil=True)
def invert(matrix, ridge, out):
    """Set out to (matrix + ridge 1)^-1 by Cholesky in float64; return whether it exists."""
    size = matrix.shape[0]
    lower = np.zeros((size, size))
    for i in range(size):
        for k in range(i + 1):
            total = np.float64(matrix[i, k])
            if i == k:
                total += ridge
            row, other = lower[i], lower[k]
            for p in range(k):
                total -= row[p] * other[p]
            if i == k:
                if not total > 0:
                    return False
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, k] = total / lower[k, k]
    inverse = np.zeros((size, size))
    for i in range(size):
        own = inverse[i]
        own[i] = 1 / lower[i, i]
        for k in range(i):
            factor = lower[i, k] / lower[i, i]
            other = inverse[k]
            for p in range(k + 1):
                own[p] -= factor * other[p]
    total = np.zeros((size, size))
    for i in range(size):
        own = inverse[i]
        for k in range(i + 1):
            factor = own[k]
            row = total[k]
            for p in range(i + 1):
                row[p] += factor * own[p]
    for i in range(size):
        for k in range(size):
            out[i, k] = total[i, k]
    return True


@njit(cache=True, fastmath=True, nogil=True)
def factor(atoms, rho, out):
    """Set out to (A A^T + rho 1)^-1, (measurement, measurement); return whether it exists.

    With fewer atoms than measurements by Woodbury, (1 - A (A^T A + rho 1)^-1 A^T) / rho.
    """
    count, length = atoms.shape
    if count >= length:
        gram(atoms, out)
        return invert(out, np.float64(rho), out)
    small = np.empty((count, count))
    _pairwise(atoms, small)
    if not invert(small, np.float64(rho), small):
        return False
    total = np.zeros((length, length))
    part = np.empty(length)
    for i in range(count):
        part[:] = 0
        for j in range(count):
            weight = small[i, j]
            a = atoms[j]
            for k in range(length):
                part[k] += weight * a[k]
        a = atoms[i]
        for k in range(length):
            weight = np.float64(a[k])
            row = total[k]
            for p in range(length):
                row[p] += weight * part[p]
    for i in range(length):
        for k in range(length):
            out[i, k] = ((1.0 if i == k else 0.0) - total[i, k]) / rho
    return True


@njit(cache=True, fastmath=True, nogil=True)
def correlate(atoms, vector, out):
    """Set out (atom,) to the atoms' inner products with the vector; return the largest size."""
    count, length = atoms.shape
    largest = np.float32(0)
    for j in range(count):
        a = atoms[j]
        total = np.float32(0)
        for k in range(length):
            total += a[k] * vector[k]
        out[j] = total
        largest = max(largest, abs(total))
    return largest


@njit(cache=True, fastmath=True, nogil=True)
def combine(atoms, code, out):
    """Set out (measurement,) to the atoms weighted by the code."""
    out[:] = 0
    for j in range(code.size):
        weight = code[j]
        if weight != 0:
            a = atoms[j]
            for k in range(out.size):
                out[k] += weight * a[k]


@njit(cache=True, fastmath=True, nogil=True)
def norms(atoms, out):
    """Set out (atom,) to the atoms' Euclidean norms."""
    for j in range(atoms.shape[0]):
        total = np.float32(0)
        for value in atoms[j]:
            total += value * value
        out[j] = np.sqrt(total)


@njit(cache=True, nogil=True)
def objective_and_gap(atoms, data, eta, code, correlation):
    """Return the objective of eq. 8 and its relative duality gap; set the correlations.

    The dual point is the residual, shrunk until no atom correlates with it more than eta.
    """
    fitted = np.empty(data.size, data.dtype)
    combine(atoms, code, fitted)
    residual = data - fitted
    largest = correlate(atoms, residual, correlation)
    shrink = 1.0 if largest <= eta else eta / largest
    objective, dual = _values(data, fitted, residual, shrink, eta, np.abs(code).sum())
    return objective, (objective - dual) / objective if objective > 0 else 0.0


@njit(cache=True, fastmath=True, nogil=True)
def _values(data, fitted, dual_point, shrink, eta, size):
    """Return the values of eq. 8, |code|_1 being `size`, and of its dual at the shrunk point."""
    fit = 0.0
    dual = 0.0
    for k in range(data.size):
        value = np.float64(data[k])
        fit += (value - fitted[k]) ** 2
        dual += value**2 - (value - np.float64(shrink) * dual_point[k]) ** 2
    return 0.5 * fit + eta * size, 0.5 * dual


@njit(cache=True, fastmath=True, nogil=True)
def _soft(value, threshold):
    zero = np.float32(0)
    return max(value - threshold, zero) + min(value + threshold, zero)


@njit(cache=True, fastmath=True, nogil=True)
def _splitting_pass(atoms, pull, threshold, relax, state, fitted):
    """Do one step of every atom's state; set fitted to A z; return max |A^T pull|, |z|_1."""
    count, length = atoms.shape
    fitted[:] = 0
    largest = np.float32(0)
    size = np.float32(0)
    for j in range(count):
        a = atoms[j]
        gain = np.float32(0)
        for k in range(length):
            gain += a[k] * pull[k]
        largest = max(largest, abs(gain))
        value = state[j]
        value += relax * (_soft(value, threshold) - value + gain)
        state[j] = value
        kept = _soft(value, threshold)
        if kept != 0:
            size += abs(kept)
            for k in range(length):
                fitted[k] += kept * a[k]
    return largest, size


@njit(cache=True, fastmath=True, nogil=True)
def split(atoms, inverse, data, eta, rho, relax, rtol, max_steps, state, dual_point):
    """Run ADMM on `atoms` from its state w (atom,); return steps, objective, relative gap.

    inverse: (A A^T + rho 1)^-1, by `factor`.

    Scaled ADMM with over-relaxation, in Douglas-Rachford's one variable w = x + u per atom:
    z = soft(w, eta / rho), u = w - z. With q = z - u the quadratic step is, by Woodbury,
    x = q + A^T s, s = (A A^T + rho 1)^-1 (data - A q): one pass over the atoms, since A q =
    2 A z - A w and A w follows from its own recursion. rho s, shrunk until no atom correlates
    with it more than eta, is a dual point at no cost; the last is left in dual_point.
    """
    length = data.size
    threshold = np.float32(eta / rho)
    fitted = np.zeros(length, np.float32)
    carried = np.zeros(length, np.float32)
    miss = np.empty(length, np.float32)
    pull = np.empty(length, np.float32)
    kept = np.empty(state.size, np.float32)
    for j in range(state.size):
        kept[j] = _soft(state[j], threshold)
    combine(atoms, kept, fitted)
    combine(atoms, state, carried)
    objective = np.inf
    gap = 1.0
    for step in range(max_steps):
        for k in range(length):
            miss[k] = data[k] - 2 * fitted[k] + carried[k]
        for i in range(length):
            total = np.float32(0)
            row = inverse[i]
            for k in range(length):
                total += row[k] * miss[k]
            pull[i] = total
        for k in range(length):
            carried[k] += relax * (fitted[k] - carried[k] + miss[k] - rho * pull[k])
        largest, size = _splitting_pass(atoms, pull, threshold, relax, state, fitted)
        shrink = rho
        if rho * largest > eta:
            shrink = eta / largest
        objective, dual = _values(data, fitted, pull, shrink, eta, size)
        gap = (objective - dual) / objective if objective > 0 else 0.0
        if gap <= rtol or step + 1 == max_steps:
            for k in range(length):
                dual_point[k] = shrink * pull[k]
            return step + 1, objective, gap
    return max_steps, objective, gap


@njit(cache=True, nogil=True)
def _cut(values, chosen, wanted):
    """Return the value above which about `wanted` of those not chosen lie."""
    top = np.float32(0)
    for j in range(values.size):
        if not chosen[j]:
            top = max(top, abs(values[j]))
    if top <= 0:
        return np.float32(np.inf)
    counts = np.zeros(BINS, np.int64)
    for j in range(values.size):
        if not chosen[j]:
            counts[min(BINS - 1, int(abs(values[j]) / top * BINS))] += 1
    found = 0
    edge = BINS
    while edge > 0 and found < wanted:
        edge -= 1
        found += counts[edge]
    return np.float32(top * edge / BINS)


@njit(cache=True, nogil=True)
def admm(atoms, inverse, data, eta, rho, relax, rtol, max_steps, code):
    """Solve eq. 8 by ADMM on a growing working set; return steps and the relative gap.

    A few steps on all atoms find which matter. ADMM then runs on those alone; atoms outside that
    correlate with its dual point more than eta join, and it goes on from where it was. The gap
    is that of the whole problem. Steps are counted in passes over all atoms.
    """
    count, length = atoms.shape
    state = np.zeros(count, np.float32)
    dual_point = np.empty(length, np.float32)
    correlation = np.empty(count, np.float32)
    threshold = np.float32(eta / rho)
    code[:] = 0
    first = min(max_steps, FIRST_STEPS)
    steps, objective, gap = split(
        atoms, inverse, data, eta, rho, relax, rtol, first, state, dual_point
    )
    for j in range(count):
        code[j] = _soft(state[j], threshold)
    work = float(steps)
    chosen = np.zeros(count, np.bool_)
    edge = _cut(state, chosen, 2 * length)
    for j in range(count):
        chosen[j] = abs(state[j]) >= edge
    inner = INNER_SHARE * rtol
    part_inverse = np.empty_like(inverse)
    while gap > rtol and work < max_steps:
        used = chosen.sum()
        compact = np.empty((used, length), np.float32)
        part = np.empty(used, np.float32)
        place = 0
        for j in range(count):
            if chosen[j]:
                compact[place] = atoms[j]
                part[place] = state[j]
                place += 1
        if not factor(compact, rho, part_inverse):
            break
        allowed = int((max_steps - work) * count / used) + 1
        steps, objective, _ = split(
            compact, part_inverse, data, eta, rho, relax, inner, allowed, part, dual_point
        )
        work += steps * used / count + 1
        place = 0
        for j in range(count):
            code[j] = 0
            if chosen[j]:
                state[j] = part[place]
                code[j] = _soft(part[place], threshold)
                place += 1
        largest = correlate(atoms, dual_point, correlation)
        shrink = 1.0 if largest <= eta else eta / largest
        _, dual = _values(data, data, dual_point, shrink, eta, 0.0)
        gap = (objective - dual) / objective if objective > 0 else 0.0
        edge = max(np.float32(eta), _cut(correlation, chosen, length))
        joined = 0
        for j in range(count):
            if not chosen[j] and abs(correlation[j]) >= edge:
                chosen[j] = True
                state[j] = 0
                joined += 1
        if joined == 0:
            inner *= INNER_SHARE
    return work, gap


@njit(cache=True, fastmath=True, nogil=True)
def _correlations_along(atoms, vector, out):
    """Set out (atom,) to the atoms' inner products with a float64 vector, in float32."""
    length = vector.size
    narrow = np.empty(length, np.float32)
    for k in range(length):
        narrow[k] = vector[k]
    correlate(atoms, narrow, out)


@njit(cache=True, fastmath=True, nogil=True)
def _grow(lower, used, rows, atom):
    """Add an atom to the Cholesky factor of the chosen atoms' Gram matrix; False if dependent."""
    length = atom.size
    own = 0.0
    for k in range(length):
        own += np.float64(atom[k]) ** 2
    left = own
    for i in range(used):
        total = 0.0
        row = rows[i]
        for k in range(length):
            total += row[k] * atom[k]
        for p in range(i):
            total -= lower[i, p] * lower[used, p]
        lower[used, i] = total / lower[i, i]
        left -= lower[used, i] ** 2
    if not left > DEPENDENT**2 * own:
        return False
    lower[used, used] = np.sqrt(left)
    for k in range(length):
        rows[used, k] = atom[k]
    return True


@njit(cache=True, fastmath=True, nogil=True)
def _solve(lower, used, right, out):
    """Set out to the solution for the Cholesky factor's matrix."""
    for i in range(used):
        total = right[i]
        for p in range(i):
            total -= lower[i, p] * out[p]
        out[i] = total / lower[i, i]
    for i in range(used - 1, -1, -1):
        total = out[i]
        for p in range(i + 1, used):
            total -= lower[p, i] * out[p]
        out[i] = total / lower[i, i]


@njit(cache=True, fastmath=True, nogil=True)
def _orthogonal_part(basis, used, atom, shares, out):
    """Set shares to what `used` rows of the basis explain of the atom, out to what they do not."""
    for k in range(atom.size):
        out[k] = atom[k]
    for i in range(used):
        row = basis[i]
        share = 0.0
        for k in range(out.size):
            share += row[k] * out[k]
        shares[i] = share
        for k in range(out.size):
            out[k] -= share * row[k]


@njit(cache=True, nogil=True)
def omp(atoms, data, most, tolerance, code):
    """Set code by orthogonal matching pursuit; return the atoms chosen and the residual's norm.

    The atom that best explains the residual (by the cosine) joins, all coefficients are fitted
    anew; until `most` atoms, or the residual's norm is at most the tolerance (Pati 1993).
    """
    count, length = atoms.shape
    most = min(most, count, length)
    code[:] = 0
    size = np.empty(count, np.float32)
    norms(atoms, size)
    weakest = DARKEST * size.max()
    for j in range(count):
        size[j] = 1 / size[j] if size[j] > weakest else np.float32(0)
    correlation = np.empty(count, np.float32)
    basis = np.empty((most + 1, length))
    shares = np.zeros((most + 1, most + 1))
    explained = np.empty(most)
    chosen = np.empty(most, np.int64)
    residual = data.astype(np.float64)
    left = np.sqrt((residual**2).sum())
    used = 0
    while used < most and left > tolerance:
        _correlations_along(atoms, residual, correlation)
        best = NONE
        top = np.float32(0)
        for j in range(count):
            value = abs(correlation[j]) * size[j]
            if value > top:
                top = value
                best = j
        if best == NONE:
            break
        new = basis[used]
        _orthogonal_part(basis, used, atoms[best], shares[used], new)
        own = np.sqrt((new**2).sum())
        independent = own * size[best] > DEPENDENT
        size[best] = 0
        if not independent:
            continue
        new /= own
        shares[used, used] = own
        explained[used] = (new * residual).sum()
        residual -= explained[used] * new
        left = np.sqrt((residual**2).sum())
        chosen[used] = best
        used += 1
    for i in range(used - 1, -1, -1):
        weight = explained[i]
        for p in range(i + 1, used):
            weight -= shares[p, i] * explained[p]
        explained[i] = weight / shares[i, i]
        code[chosen[i]] = explained[i]
    return used, left


@njit(cache=True, fastmath=True, nogil=True)
def _join_steps(correlation, slope, blocked, level, out):
    """Set out (atom,) to the step at which each joins, if not blocked; return the least.

    An atom joins at the level, which falls by the step, its correlation by step times slope.
    """
    least = np.float32(NEVER)
    one, tiny = np.float32(1), np.float32(1e-9)
    for j in range(out.size):
        up = (level - correlation[j]) / max(one - slope[j], tiny)
        down = (level + correlation[j]) / max(one + slope[j], tiny)
        out[j] = min(up, down) + blocked[j]
        least = min(least, out[j])
    return least


@njit(cache=True, nogil=True)
def lars(atoms, data, eta, max_steps, code):
    """Follow the minimiser of eq. 8 from the largest penalty down to eta; return the steps.

    The Lasso path of least angle regression (Efron 2004): every step ends where an atom joins or
    leaves. NONE when the step limit came first; the code is then that of a larger penalty.
    """
    count, length = atoms.shape
    room = min(count, length)
    code[:] = 0
    correlation = np.empty(count, np.float32)
    slope = np.empty(count, np.float32)
    joins = np.empty(count, np.float32)
    blocked = np.zeros(count, np.float32)
    lower = np.zeros((room + 1, room + 1))
    rows = np.empty((room + 1, length))
    chosen = np.empty(room + 1, np.int64)
    signs = np.empty(room + 1)
    weights = np.zeros(room + 1)
    direction = np.empty(room + 1)
    toward = np.empty(length)
    left = np.empty(count, np.int64)
    dependent = np.empty(count, np.int64)
    residual = data.astype(np.float64)
    _correlations_along(atoms, residual, correlation)
    level = 0.0
    joining = NONE
    for j in range(count):
        if abs(correlation[j]) > level:
            level = abs(correlation[j])
            joining = j
    refreshed = level
    used = steps = resting = refused = 0
    while level > eta and steps < max_steps:
        if joining != NONE:
            if used < room and _grow(lower, used, rows, atoms[joining]):
                chosen[used] = joining
                signs[used] = 1.0 if correlation[joining] > 0 else -1.0
                weights[used] = 0.0
                used += 1
            else:
                # It adds nothing to the atoms inside, until one of them leaves.
                dependent[refused] = joining
                refused += 1
            blocked[joining] = NEVER
        _solve(lower, used, signs, direction)
        toward[:] = 0
        for i in range(used):
            toward += direction[i] * rows[i]
        _correlations_along(atoms, toward, slope)
        reach = level - eta
        joining = NONE
        leaving = NONE
        nearest = _join_steps(correlation, slope, blocked, np.float32(level), joins)
        if nearest < reach:
            for j in range(count):
                if joins[j] == nearest:
                    joining = j
                    break
            reach = max(np.float64(nearest), 0.0)
        for i in range(used):
            # By its sign, not by its weight: of two that reach 0 together one may be past it.
            if signs[i] * direction[i] < 0:
                step = max(signs[i] * weights[i], 0.0) / abs(direction[i])
                if step < reach:
                    reach = step
                    leaving = i
                    joining = NONE
        level -= reach
        for i in range(used):
            weights[i] += reach * direction[i]
        residual -= reach * toward
        steps += 1
        if level < FRESH * refreshed:
            refreshed = level
            _correlations_along(atoms, residual, correlation)
        else:
            for j in range(count):
                correlation[j] -= reach * slope[j]
        if reach > 0:
            for i in range(resting):
                blocked[left[i]] = 0
            resting = 0
        if leaving != NONE:
            # It is at the level still, and must not come back before the level falls.
            left[resting] = chosen[leaving]
            resting += 1
            for i in range(refused):
                blocked[dependent[i]] = 0
            refused = 0
            used -= 1
            for i in range(leaving, used):
                chosen[i], signs[i], weights[i] = chosen[i + 1], signs[i + 1], weights[i + 1]
                rows[i] = rows[i + 1]
            for i in range(leaving, used):
                _grow(lower, i, rows, atoms[chosen[i]])
    for i in range(used):
        code[chosen[i]] = weights[i]
    return steps if level <= eta else NONE


@njit(cache=True, fastmath=True, nogil=True)
def _largest_eigenvalue(matrix):
    """Return an upper estimate of a symmetric matrix's largest eigenvalue by power iteration."""
    size = matrix.shape[0]
    vector = np.ones(size)
    value = 0.0
    for _ in range(POWER_STEPS):
        image = np.zeros(size)
        for i in range(size):
            for k in range(size):
                image[i] += matrix[i, k] * vector[k]
        value = np.sqrt((image**2).sum())
        if value == 0:
            return 0.0
        vector = image / value
    return POWER_MARGIN * value


@njit(cache=True, fastmath=True, nogil=True)
def _gradient_pass(atoms, residual, step, threshold, momentum, code, older, fitted):
    """Do one proximal gradient step from the extrapolated code; set fitted to A code.

    Returns the largest correlation, |code|_1, and the sign of the restart test.
    """
    count, length = atoms.shape
    fitted[:] = 0
    largest = np.float32(0)
    size = np.float32(0)
    test = np.float32(0)
    for j in range(count):
        a = atoms[j]
        gain = np.float32(0)
        for k in range(length):
            gain += a[k] * residual[k]
        largest = max(largest, abs(gain))
        now = code[j]
        ahead = now + momentum * (now - older[j])
        new = _soft(ahead + step * gain, threshold)
        test += (ahead - new) * (new - now)
        older[j] = now
        code[j] = new
        if new != 0:
            size += abs(new)
            for k in range(length):
                fitted[k] += new * a[k]
    return largest, size, test


@njit(cache=True, nogil=True)
def proximal_gradient(atoms, data, eta, accelerate, rtol, max_steps, code):
    """Solve eq. 8 by ISTA, or by FISTA with adaptive restart; return steps and relative gap.

    Beck and Teboulle 2009; the restart is that of O'Donoghue and Candes 2015. The step is 1 over
    the largest eigenvalue of A A^T.
    """
    count, length = atoms.shape
    blocks = np.empty((length, length), np.float32)
    gram(atoms, blocks)
    code[:] = 0
    curvature = _largest_eigenvalue(blocks)
    if curvature <= 0:
        return 0, 0.0
    step = np.float32(1 / curvature)
    threshold = np.float32(eta / curvature)
    older = np.zeros(count, np.float32)
    fitted = np.zeros(length, np.float32)
    before = np.zeros(length, np.float32)
    extrapolated = np.zeros(length, np.float32)
    residual = data.copy()
    t = 1.0
    momentum = np.float32(0)
    gap = 1.0
    best_dual = -np.inf
    objective, size = 0.5 * np.float64((data**2).sum()), np.float32(0)
    for taken in range(max_steps):
        before[:] = fitted
        largest, size, test = _gradient_pass(
            atoms, residual, step, threshold, momentum, code, older, fitted
        )
        shrink = 1.0 if largest <= eta else eta / largest
        _, dual = _values(data, data, residual, shrink, eta, 0.0)
        best_dual = max(best_dual, dual)
        objective, _ = _values(data, fitted, residual, shrink, eta, size)
        gap = (objective - best_dual) / objective if objective > 0 else 0.0
        if gap <= rtol:
            return taken + 1, gap
        if accelerate:
            if test > 0:
                t = 1.0
            t_new = 0.5 * (1 + np.sqrt(1 + 4 * t * t))
            momentum = np.float32((t - 1) / t_new)
            t = t_new
        extrapolated[:] = fitted + momentum * (fitted - before)
        residual[:] = data - extrapolated
    return max_steps, gap


@njit(cache=True, fastmath=True, nogil=True)
def _smoothed_pass(atoms, pull, width, code, fitted):
    """Move the code by A^T pull, shrink what is small against the width; set fitted to A code."""
    count, length = atoms.shape
    fitted[:] = 0
    for j in range(count):
        a = atoms[j]
        gain = np.float32(0)
        for k in range(length):
            gain += a[k] * pull[k]
        value = code[j] + gain
        if width > 0:
            value -= value * np.exp(-value * value / (2 * width * width))
        code[j] = value
        for k in range(length):
            fitted[k] += value * a[k]


@njit(cache=True, nogil=True)
def sl0(atoms, data, tolerance, shrink, inner_steps, narrowest, ridge, code):
    """Set code by smoothed l0 (Mohimani 2009): the fewest atoms that explain the data.

    From the least-squares code, sum(1 - exp(-code^2 / 2 width^2)) is lowered by a few gradient
    steps for ever smaller widths (by `shrink`, down to `narrowest` times the largest
    coefficient); after each the code is projected back onto the data, where it misses them by
    more than the tolerance. ridge: of A A^T, relative. Returns the passes and the residual.
    """
    length = data.size
    blocks = np.empty((length, length), np.float32)
    inverse = np.empty((length, length), np.float32)
    gram(atoms, blocks)
    code[:] = 0
    scale = 0.0
    for k in range(length):
        scale = max(scale, blocks[k, k])
    if scale == 0 or not invert(blocks, ridge * scale, inverse):
        return 0, np.sqrt(np.float64((data**2).sum()))
    fitted = np.zeros(length, np.float32)
    pull = inverse @ data
    _smoothed_pass(atoms, pull, np.float32(0), code, fitted)
    width = np.float32(2 * np.abs(code).max())
    last = np.float32(narrowest) * width
    taken = 1
    pull[:] = 0
    while width > last:
        for _ in range(inner_steps):
            _smoothed_pass(atoms, pull, width, code, fitted)
            taken += 1
            miss = data - fitted
            pull[:] = 0
            if np.sqrt((miss**2).sum()) > tolerance:
                pull = inverse @ miss
        width *= np.float32(shrink)
    _smoothed_pass(atoms, pull, np.float32(0), code, fitted)
    return taken, np.sqrt(np.float64(((data - fitted) ** 2).sum()))
