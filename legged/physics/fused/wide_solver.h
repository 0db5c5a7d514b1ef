// MuJoCo's Newton solver for the constraint forces of WIDE worlds at once on a CPU: the solver of constraint_solver.h, for
// friction pyramids, with the numbers of all worlds in vector registers. Worlds with fewer rows than others have empty rows,
// and worlds that have converged wait for the others of their block. A block has the worlds from `start` to before `end`, at
// most WIDE. Constants: WIDE, NV (degrees of freedom), ROWS (largest number of constraint rows), ENTRIES (stored entries of
// the mass matrix), DAMPED (dampers are integrated implicitly), KNOWN (rows have keys, with which their states of the last
// step are found), FRICTION (there may be rows of dry friction), COUPLED (a row may move degrees of freedom of several
// branches). Tables: PATHS (the path from the root to each degree of freedom), PATH_START and PATH_LENGTH (start and length
// of each path in PATHS), ENTRY_PLACE (place of each entry of the mass matrix in a matrix whose rows have the entries of
// PATHS).

// A Wide holds a number for each world. A Mask holds an integer for each world: -1 (all bits set) for true, 0 for false.
typedef float Wide __attribute__((vector_size(4 * WIDE), may_alias));
typedef int Mask __attribute__((vector_size(4 * WIDE), may_alias));
const Wide ZERO = Wide{};
const Wide ONE = ZERO + 1.0f;
const float TINY = 1e-15f, INFINITE = 3.0e38f, ENOUGH = 0.1f;
const float tolerance = arrays.tolerance, ls_tolerance = arrays.ls_tolerance;
const int SPARSE = PATH_START[NV - 1] + PATH_LENGTH[NV - 1], DENSE = NV * (NV + 1) / 2;

auto any_of = [](const Mask& mask) {
    int some = 0;
    for (int w = 0; w < WIDE; ++w) some |= mask[w];
    return some != 0;
};

int at[WIDE];  // indices of the worlds; the last world is repeated if there are too few
int rows = 0;
// for each world: numbers of all rows, of equality rows, and of equality and dry friction rows together
Mask own_rows, equalities, plain;
for (int w = 0; w < WIDE; ++w) {
    at[w] = start + w < end ? start + w : end - 1;
    const int own = arrays.nefc.data[at[w]] < ROWS ? arrays.nefc.data[at[w]] : ROWS;
    own_rows[w] = own;
    rows = own > rows ? own : rows;
    equalities[w] = arrays.equalities.data[at[w]];
    plain[w] = equalities[w] + (FRICTION ? arrays.frictions.data[at[w]] : 0);
}

// Returns a reference to world w's number. Writing to it does not read and write a whole register.
auto of = [&](Wide& all, int w) -> float& { return reinterpret_cast<float*>(&all)[w]; };
Wide J[ROWS][NV], D[ROWS], x[ROWS], force[ROWS], curvature[ROWS], jv[ROWS], least[ROWS], greatest[ROWS];
Mask states[ROWS];
bool couples[ROWS];
Wide M[SPARSE], H[COUPLED ? DENSE : SPARSE];
Wide a[NV], Ma[NV], Ms[NV], smooth[NV], pushed[NV], grad[NV], s[NV], over[NV];
const int width = arrays.jacobian.shape[2];

for (int r = 0; r < rows; ++r) couples[r] = false;
for (int w = 0; w < WIDE; ++w) {
    const long long world = at[w];
    const int own = own_rows[w];
    const float* jacobian = arrays.jacobian.data + world * arrays.jacobian.shape[1] * width;
    for (int r = 0; r < own; ++r) {
        for (int j = 0; j < NV; ++j) of(J[r][j], w) = jacobian[r * width + j];
        of(D[r], w) = arrays.stiffness.data[world * arrays.stiffness.shape[1] + r];
        of(x[r], w) = -arrays.reference.data[world * arrays.reference.shape[1] + r];
        const float loss = FRICTION ? arrays.frictionloss.data[world * arrays.frictionloss.shape[1] + r] : 0.0f;
        const bool dry = FRICTION && r >= equalities[w];
        of(least[r], w) = r >= plain[w] ? 0.0f : dry ? -loss : -INFINITE;
        of(greatest[r], w) = r >= plain[w] || !dry ? INFINITE : loss;
        if (COUPLED) {
            unsigned long long moved = 0;
            int last = 0;
            for (int j = 0; j < NV; ++j) if (jacobian[r * width + j] != 0.0f) { moved |= 1ull << j; last = j; }
            couples[r] |= (moved & ~arrays.path.data[last]) != 0;
        }
    }
    for (int r = own; r < rows; ++r) {
        for (int j = 0; j < NV; ++j) of(J[r][j], w) = 0.0f;
        of(D[r], w) = of(x[r], w) = of(least[r], w) = of(greatest[r], w) = 0.0f;
    }
    for (int i = 0; i < NV; ++i) {
        of(a[i], w) = arrays.warmstart.data[world * arrays.warmstart.shape[1] + i];
        of(smooth[i], w) = arrays.qfrc_smooth.data[world * arrays.qfrc_smooth.shape[1] + i];
    }
}
for (int k = 0; k < SPARSE; ++k) M[k] = ZERO;
for (int k = 0; k < ENTRIES; ++k) {
    const float* inertia = arrays.inertia.data + k;
    for (int w = 0; w < WIDE; ++w) of(M[ENTRY_PLACE[k]], w) = inertia[(long long)at[w] * arrays.inertia.shape[1]];
}
Wide trace = ZERO;
for (int i = 0; i < NV; ++i) trace += M[PATH_START[i] + PATH_LENGTH[i] - 1];
const Wide scale = 1.0f / (trace > TINY ? trace : ZERO + TINY);

// Computes out = M v.
auto times_inertia = [&](const Wide* v, Wide* out) {
    for (int i = 0; i < NV; ++i) {
        const Wide* row = M + PATH_START[i];
        const int* path = PATHS + PATH_START[i];
        Wide total = row[PATH_LENGTH[i] - 1] * v[i];
        for (int t = 0; t < PATH_LENGTH[i] - 1; ++t) {
            total += row[t] * v[path[t]];
            out[path[t]] += row[t] * v[i];
        }
        out[i] = total;  // the rows of i's descendants add to it later
    }
};
auto along_row = [&](int r, const Wide* v) {
    Wide one = ZERO, other = ZERO;
    for (int j = 0; j + 1 < NV; j += 2) { one += J[r][j] * v[j]; other += J[r][j + 1] * v[j + 1]; }
    if (NV % 2) one += J[r][NV - 1] * v[NV - 1];
    return one + other;
};
times_inertia(a, Ma);
for (int r = 0; r < rows; ++r) {
    x[r] += along_row(r, a);
    states[r] = Mask{} + UNKNOWN;
}
// Read the row states of the last step. They are not used after a reset, which sets the last acceleration to zero. In this
// file a state is 0 on the quadratic piece of the cost, -1 at the least force and 2 at the greatest. Both steps' rows ascend
// by key.
auto last_rows = [&](int w) { return arrays.last_rows.data + (long long)at[w] * arrays.last_rows.shape[1]; };
auto row_keys = [&](int w) { return arrays.row_key.data + (long long)at[w] * arrays.row_key.shape[1]; };
Mask guess = Mask{};  // worlds with states of the last step
for (int w = 0; KNOWN && w < WIDE; ++w) {
    bool moving = false;
    for (int i = 0; i < NV; ++i) moving |= a[i][w] != 0.0f;
    const int* last = last_rows(w);
    const int had = moving ? last[0] : 0;
    guess[w] = had > 0 ? -1 : 0;
    for (int r = equalities[w], k = 0; r < own_rows[w]; ++r) {
        const int key = row_keys(w)[r];
        while (k < had && last[1 + k] >> 2 < key) ++k;
        if (k == had || last[1 + k] >> 2 != key) continue;
        const int state = (last[1 + k] & 3) - 2;
        states[r][w] = state == HOLDING ? 0 : state == SLIPPING_BACK ? 2 : -1;
    }
}

// Solves H s = g in place: s holds g at first. Row i of H has entries only for the path of i in a tree. The arguments are
// functions that return a row's start, length and path elements. H = L^T diag(1 / over) L, from the leaves up.
auto solve = [&](auto start_of, auto length_of, auto path_of) {
    for (int k = NV - 1; k >= 0; --k) {
        const int last = length_of(k) - 1;
        const Wide* row = H + start_of(k);
        over[k] = 1.0f / (row[last] > TINY ? row[last] : ZERO + TINY);
        for (int t = last - 1; t >= 0; --t) {
            const int i = path_of(k, t);
            const Wide part = row[t] * over[k];
            Wide* above = H + start_of(i);
            for (int u = 0; u <= t; ++u) above[u] -= part * row[u];
            s[i] -= part * s[k];
        }
    }
    for (int k = 0; k < NV; ++k) {
        const int last = length_of(k) - 1;
        const Wide* row = H + start_of(k);
        Wide total = s[k];
        for (int t = 0; t < last; ++t) total -= row[t] * s[path_of(k, t)];
        s[k] = total * over[k];
    }
};
int pushing[ROWS], pushers = 0;
// Adds the rows in `pushing` to a tile of H: the entries t to t + columns of consecutive rows of H from i on.
struct One { enum { value = 1 }; };
struct Two { enum { value = 2 }; };
struct Three { enum { value = 3 }; };
Wide weighted[3][ROWS];
auto add_tile = [&](auto tile_rows, auto tile_columns, const Wide (*of_rows)[ROWS], int i, int t, auto start_of, auto path_of) {
    constexpr int tall = decltype(tile_rows)::value, broad = decltype(tile_columns)::value;
    Wide total[tall][broad];
    int column[broad];
    for (int c = 0; c < broad; ++c) column[c] = path_of(i, t + c);
    for (int q = 0; q < tall; ++q)
        for (int c = 0; c < broad; ++c) total[q][c] = H[start_of(i + q) + t + c];
    for (int k = 0; k < pushers; ++k) {
        const Wide* row = J[pushing[k]];
        for (int c = 0; c < broad; ++c)
            for (int q = 0; q < tall; ++q) total[q][c] += of_rows[q][k] * row[column[c]];
    }
    for (int q = 0; q < tall; ++q)
        for (int c = 0; c < broad; ++c) H[start_of(i + q) + t + c] = total[q][c];
};
// Adds the rows in `pushing`, times their curvature, to H. Takes three degrees of freedom at once if they are adjacent on a
// path.
auto add_rows = [&](auto start_of, auto length_of, auto path_of) {
    auto add_entries = [&](auto tall, const Wide (*of_rows)[ROWS], int i, int from, int to) {
        int t = from;
        for (; t + 3 <= to; t += 3) add_tile(tall, Three{}, of_rows, i, t, start_of, path_of);
        if (to - t == 2) add_tile(tall, Two{}, of_rows, i, t, start_of, path_of);
        if (to - t == 1) add_tile(tall, One{}, of_rows, i, t, start_of, path_of);
    };
    for (int i = 0, count = 1; i < NV; i += count) {
        const int length = length_of(i);
        auto follows = [&](int k) { return length_of(k) == length + k - i && path_of(k, length + k - i - 2) == k - 1; };
        count = i + 2 < NV && follows(i + 1) && follows(i + 2) ? 3 : 1;
        for (int q = 0; q < count; ++q)
            for (int k = 0; k < pushers; ++k) weighted[q][k] = curvature[pushing[k]] * J[pushing[k]][i + q];
        if (count == 3) add_entries(Three{}, weighted, i, 0, length); else add_entries(One{}, weighted, i, 0, length);
        for (int q = 1; q < count; ++q) add_entries(One{}, weighted + q, i + q, length, length + q);
    }
};
auto sparse_start = [](int i) { return PATH_START[i]; };
auto sparse_length = [](int i) { return PATH_LENGTH[i]; };
auto sparse_path = [](int i, int t) { return PATHS[PATH_START[i] + t]; };
[[maybe_unused]] auto dense_start = [](int i) { return i * (i + 1) / 2; };
[[maybe_unused]] auto dense_length = [](int i) { return i + 1; };
[[maybe_unused]] auto dense_path = [](int, int t) { return t; };

Mask active = Mask{} - 1, rounds = Mask{};
Wide alpha = ZERO;  // last step length; if it is 1 and no state changes, the minimum is reached
for (int round = 0;; ++round) {
    // The first step goes to the minimum of the quadratic function that the states of the last step define.
    const bool guessing = KNOWN && round == 0 && any_of(guess);
    // Compute the forces, whether rows changed their states, and the gradient.
    Mask changed = Mask{};
    bool coupled = false;
    pushers = 0;
    for (int i = 0; i < NV; ++i) pushed[i] = ZERO;
    for (int r = 0; r < rows; ++r) {
        const Wide pull = -D[r] * x[r];
        Mask low = pull <= least[r], high = pull >= greatest[r];
        if (guessing) {
            const Mask known = guess & (states[r] != UNKNOWN);
            low = known ? states[r] == -1 : low;
            high = known ? states[r] == 2 : high;
        }
        force[r] = low ? least[r] : high ? greatest[r] : pull;
        curvature[r] = low | high ? ZERO : D[r];
        const Mask state = low - 2 * high;  // true is -1 in a mask
        changed |= state != states[r];
        states[r] = state;
        if (!any_of((force[r] != 0.0f) | (curvature[r] != 0.0f))) continue;
        pushing[pushers++] = r;
        coupled |= COUPLED && couples[r];
        for (int i = 0; i < NV; ++i) pushed[i] += J[r][i] * force[r];
    }
    Wide squares = ZERO;
    for (int i = 0; i < NV; ++i) {
        grad[i] = Ma[i] - smooth[i] - pushed[i];
        squares += grad[i] * grad[i];
        s[i] = -grad[i];
    }
    if (round == arrays.most_rounds) break;
    const Mask whole = guessing ? guess : Mask{};  // worlds that take a full step
    active &= whole | ~(scale * scale * squares < tolerance * tolerance);
    active &= changed | (alpha != ONE);
    if (!any_of(active)) break;
    // Compute the step s = -H^-1 grad.
    if (COUPLED && coupled) {
        for (int k = 0; k < DENSE; ++k) H[COUPLED ? k : 0] = ZERO;
        for (int i = 0; i < NV; ++i)
            for (int t = 0; t < PATH_LENGTH[i]; ++t) H[COUPLED ? dense_start(i) + sparse_path(i, t) : 0] = M[PATH_START[i] + t];
        add_rows(dense_start, dense_length, dense_path);
        solve(dense_start, dense_length, dense_path);
    } else {
        for (int k = 0; k < SPARSE; ++k) H[k] = M[k];
        add_rows(sparse_start, sparse_length, sparse_path);
        solve(sparse_start, sparse_length, sparse_path);
    }
    // Compute J s for every row. The inertial cost has the derivative slope + alpha * bend along the step.
    times_inertia(s, Ms);
    Wide slope = ZERO, bend = ZERO, length = ZERO, decrement = ZERO;
    for (int i = 0; i < NV; ++i) {
        slope += s[i] * (Ma[i] - smooth[i]);
        bend += s[i] * Ms[i];
        length += s[i] * s[i];
        decrement -= s[i] * grad[i];
    }
    // Continue only in worlds in which the step gains enough. For NaN, the comparison is false.
    active &= scale * 0.5f * decrement >= (whole ? ZERO - INFINITE : ZERO + tolerance);
    if (!any_of(active)) break;
    for (int r = 0; r < rows; ++r) jv[r] = along_row(r, s);
    // The line search may stop early, since the next iteration reduces the slope further. `flat` is a squared slope.
    const Wide least_slope = tolerance * tolerance * ls_tolerance * ls_tolerance * length / (scale * scale);
    const Wide slope_left = ENOUGH * ENOUGH * decrement * decrement;
    const Wide flat = least_slope > slope_left ? least_slope : slope_left;
    alpha = ONE;
    Wide low = ZERO, high = -ONE;
    // The second step needs no line search either, since the row states that it starts from are mostly right.
    Mask searching = KNOWN && round == 1 ? Mask{} : active & ~whole;
    for (int k = 0; k < arrays.most_searches && any_of(searching); ++k) {
        Wide first = slope + alpha * bend, second = bend;
        for (int r = 0; r < rows; ++r) {
            const Wide pull = -D[r] * (x[r] + alpha * jv[r]);
            const Mask below = pull <= least[r], above = pull >= greatest[r];
            first -= jv[r] * (below ? least[r] : above ? greatest[r] : pull);
            second += below | above ? ZERO : jv[r] * jv[r] * D[r];
        }
        searching &= first * first > flat;
        if (!any_of(searching)) break;
        low = (searching & (first < 0.0f)) ? alpha : low;
        high = (searching & ~(first < 0.0f)) ? alpha : high;
        const Wide next = alpha - first / second, change = next - alpha;
        searching &= ~((change < 0.0f ? -change : change) <= 1e-7f * alpha);  // float32 resolves no smaller change
        const Mask outside = (high > 0.0f) & ((next <= low) | (next >= high));
        alpha = searching ? (outside ? 0.5f * (low + high) : next) : alpha;
    }
    for (int i = 0; i < NV; ++i) {
        a[i] = active ? a[i] + alpha * s[i] : a[i];
        Ma[i] = active ? Ma[i] + alpha * Ms[i] : Ma[i];
    }
    for (int r = 0; r < rows; ++r) x[r] = active ? x[r] + alpha * jv[r] : x[r];
    rounds -= active;
}

if (DAMPED) {  // (M + h D) s = all forces: dampers act at the end of the step
    for (int k = 0; k < SPARSE; ++k) H[k] = M[k];
    for (int i = 0; i < NV; ++i) {
        s[i] = smooth[i] + pushed[i];
        for (int w = 0; w < WIDE; ++w)
            H[PATH_START[i] + PATH_LENGTH[i] - 1][w] += arrays.timestep.data[at[w] % arrays.timestep.shape[0]]
                * arrays.damping.data[(long long)(at[w] % arrays.damping.shape[0]) * NV + i];
    }
    solve(sparse_start, sparse_length, sparse_path);
}
for (int w = 0; w < WIDE && start + w < end; ++w) {
    const long long world = at[w];
    for (int i = 0; i < NV; ++i) {
        arrays.qacc.data[world * arrays.qacc.shape[1] + i] = a[i][w];
        arrays.inertial.data[world * arrays.inertial.shape[1] + i] = Ma[i][w];
        arrays.qfrc_constraint.data[world * arrays.qfrc_constraint.shape[1] + i] = pushed[i][w];
        if (DAMPED) arrays.advance.data[world * NV + i] = s[i][w];
    }
    for (int r = 0; r < own_rows[w]; ++r) arrays.efc_force.data[world * arrays.efc_force.shape[1] + r] = force[r][w];
    arrays.rounds.data[world] = rounds[w];
    if (KNOWN) {
        int* last = last_rows(w);
        last[0] = own_rows[w] - equalities[w];
        for (int r = equalities[w]; r < own_rows[w]; ++r) {
            const int state = states[r][w] == 0 ? HOLDING : states[r][w] == 2 ? SLIPPING_BACK : r < plain[w] ? SLIPPING : IDLE;
            last[1 + r - equalities[w]] = row_keys(w)[r] << 2 | (state + 2);
        }
    }
}
