// Constraint rows of one world, and their distribution over lanes. Constants: NV (degrees of freedom, at most 64), ROWS
// (largest number of constraint rows), KEPT_ROWS (rows of the Jacobian in shared memory), STRIDE (floats from one row of a
// matrix to the next), ENTRIES (stored entries of the mass matrix), FRICTION (there may be rows of dry friction), DRY (all of
// these belong to degrees of freedom), SPLIT (the tree has branches), ROOT (number of degrees of freedom before the first
// branch), KNOWN (rows have keys, with which their states of the last step are found), and the row states of active_set.py.
//
// On a GPU each lane holds the data of one or two degrees of freedom, including a row of each matrix, in registers. Shared
// memory holds the data of constraint rows and the data that all lanes read often. On the CPU one thread holds everything,
// and the same source is a serial solver.

#if defined(__CUDA_ARCH__)
#define EACH_DOF(i) UNROLLED for (int slot = 0; slot < DOFS; ++slot) if (const int i = dof_at(slot); i < NV)
// Loops over a lane's rows. It is not unrolled: few worlds have over 32 rows, and short code stays in the instruction cache.
#define EACH_ROW(r) ROLLED EACH(r, rows)
// The same, but all lanes execute each pass, also with r beyond the last row, because `rank` requires it.
#define EVERY_ROW(r) ROLLED for (int first = 0; first < rows; first += 32) if (const int r = first + lane; true)
#define OF(values, i) values[slot]
const int DOFS = NV > 32 ? 2 : 1, KEPT = KEPT_ROWS;
// Returns the degree of freedom in a slot of this lane. If there are more than 32, second slots hold those of the root,
// because they need no row of a matrix.
auto dof_at = [&](int slot) {
    if (NV <= 32) return lane;
    return slot == 0 ? ROOT + lane : lane < ROOT ? lane : 32 + lane;
};
#else
#define EACH_DOF(i) for (int i = 0; i < NV; ++i)
#define EACH_ROW(r) EACH(r, rows)
#define EVERY_ROW(r) for (int r = 0; r < rows; ++r)
#define OF(values, i) values[i]
const int DOFS = NV, KEPT = 0;
#endif
LEGGED_SHARED float J[KEPT > 0 ? KEPT * STRIDE : 1], M[NV * STRIDE];
LEGGED_SHARED float shown[STRIDE];  // one number for each degree of freedom, which all lanes can read
LEGGED_SHARED float D[ROWS], x[ROWS], force[ROWS], curvature[ROWS];
float* jv = force;  // J times the step, until new forces are computed
LEGGED_SHARED signed char states[ROWS];
LEGGED_SHARED short pushing[ROWS];  // rows that exert force or have curvature
LEGGED_SHARED bool couples[ROWS];  // true for a row that moves degrees of freedom of several branches
// The arrays below have one entry for each degree of freedom's row of dry friction; `dry_row` is the row's index, or -1.
const int DRY_DOFS = DRY ? NV : 1;
LEGGED_SHARED float dry_D[DRY_DOFS], dry_loss[DRY_DOFS], dry_reference[DRY_DOFS], dry_curvature[DRY_DOFS];
LEGGED_SHARED signed char dry_states[DRY_DOFS];
LEGGED_SHARED short dry_row[DRY_DOFS];
float a[DOFS], Ms[DOFS], grad[DOFS], s[DOFS];
float rest[DOFS];  // M a - qfrc_smooth, which the constraint forces balance
const float TINY = 1e-15f;

const int ne = arrays.equalities.data[world], frictions = FRICTION ? arrays.frictions.data[world] : 0;
const int of_all = arrays.nefc.data[world] < ROWS ? arrays.nefc.data[world] : ROWS;
// With DRY, each row of dry friction is stored with its degree of freedom, and is not counted in `rows`.
const int dry = DRY ? (ne + frictions < of_all ? frictions : of_all > ne ? of_all - ne : 0) : 0;
const int rows = of_all - dry, nf = ne + (DRY ? 0 : frictions);
auto efc_row = [&](int r) { return DRY && r >= ne ? r + dry : r; };
const int width = arrays.jacobian.shape[2];  // padded length of a row
// Returns the number of row r in an array. Arrays may have room for different numbers of rows.
auto number_of = [&](const auto& array, int r) { return array.data[(long long)world * array.shape[1] + efc_row(r)]; };
const float* jacobian = arrays.jacobian.data + (long long)world * arrays.jacobian.shape[1] * width;
auto smooth = [&](int i) { return arrays.qfrc_smooth.data[world * arrays.qfrc_smooth.shape[1] + i]; };
// Calls `use(r, row)` with row r of the Jacobian, from shared memory or, in the few worlds with many rows, global memory.
auto with_row = [&](int r, auto use) {
    if (r < KEPT) use(r, static_cast<const float*>(J + r * STRIDE));
    else if (KEPT < ROWS) use(r, jacobian + (long long)efc_row(r) * width);
};
// Calls `use` for all rows in `pushing`, in every lane.
int pushers = 0, near_pushers = 0;
auto each_pushing = [&](auto use) {
    BY_TWO for (int k = 0; k < near_pushers; ++k) use(pushing[k], static_cast<const float*>(J + pushing[k] * STRIDE));
    if (KEPT < ROWS)
        ROLLED for (int k = near_pushers; k < pushers; ++k) use(pushing[k], jacobian + (long long)efc_row(pushing[k]) * width);
};
// Returns the product of row r of the Jacobian and `shown`.
auto along_row = [&](int r) {
    float total = 0.0f;
    if (r < KEPT) {
        UNROLLED for (int j = 0; j < NV; ++j) total += J[r * STRIDE + j] * shown[j];
    } else if (KEPT < ROWS) {
        ROLLED for (int j = 0; j < NV; ++j) total += jacobian[(long long)efc_row(r) * width + j] * shown[j];
    }
    return total;
};

// Returns the derivative of the dry friction cost at `at`. Sets `state` to the curvature on the quadratic piece of the cost,
// and to -1 or -2 on the linear pieces.
[[maybe_unused]] auto rub = [](float d, float loss, float at, float& state) {
    state = d;
    if (d * at > loss) { state = -1.0f; return loss; }
    if (d * at < -loss) { state = -2.0f; return -loss; }
    return d * at;
};
// Returns the same derivative for the piece that `state` names, even if `at` lies on another piece.
[[maybe_unused]] auto rub_on = [](float d, float loss, float at, float& state) {
    if (state == IDLE) return 0.0f;
    if (state < IDLE) return state == SLIPPING ? loss : -loss;
    state = d;
    return d * at;
};
// Returns the derivative of the cost of row r at `at`, and sets `state` as `rub` does.
auto pull = [&](int r, float at, float& state) {
    const float d = D[r];
    state = d;
    if (r >= nf && at >= 0.0f) { state = 0.0f; return 0.0f; }
    if (FRICTION && !DRY && r >= ne && r < nf) return rub(d, number_of(arrays.frictionloss, r), at, state);
    return d * at;
};

meet();  // wait until the previous world is finished
if (DRY) EACH(i, NV) {
    dry_row[i] = -1;
    dry_D[i] = dry_loss[i] = dry_reference[i] = dry_curvature[i] = 0.0f;
    dry_states[i] = UNKNOWN;
}
ROLLED EACH(k, NV * STRIDE) M[k] = 0.0f;
#if defined(__CUDA_ARCH__)
{
    struct alignas(16) Four { float of[4]; };  // a row is padded to whole vectors
    const int FOURS = (NV + 3) / 4, kept = rows < KEPT ? rows : KEPT;
    BY_FOUR EACH(k, kept * FOURS) {
        const int r = k / FOURS, c = 4 * (k % FOURS);
        *reinterpret_cast<Four*>(J + r * STRIDE + c) = *reinterpret_cast<const Four*>(jacobian + (long long)efc_row(r) * width + c);
    }
}
#endif
EACH_ROW(r) {
    D[r] = number_of(arrays.stiffness, r);
    x[r] = -number_of(arrays.reference, r);
    states[r] = UNKNOWN;
}
EACH_DOF(i) {
    OF(a, i) = arrays.warmstart.data[world * arrays.warmstart.shape[1] + i];
    shown[i] = OF(a, i);
}
meet();
if (DRY) EACH(k, dry) {
    const int i = arrays.id.data[(long long)world * arrays.id.shape[1] + ne + k];
    dry_row[i] = ne + k;
    dry_D[i] = arrays.stiffness.data[(long long)world * arrays.stiffness.shape[1] + ne + k];
    dry_loss[i] = arrays.frictionloss.data[(long long)world * arrays.frictionloss.shape[1] + ne + k];
    dry_reference[i] = arrays.reference.data[(long long)world * arrays.reference.shape[1] + ne + k];
}
float trace = 0.0f;
BY_FOUR EACH(k, ENTRIES) {
    const int i = arrays.entry_row.data[k], j = arrays.entry_column.data[k];
    const float m = arrays.inertia.data[(long long)world * arrays.inertia.shape[1] + k];
    M[i * STRIDE + j] = m;
    M[j * STRIDE + i] = m;
    if (i == j) trace += m;
}
const float scale = 1.0f / most(TINY, sum(trace));
meet();
EACH_DOF(i) {
    float total = 0.0f;
    UNROLLED for (int j = 0; j < NV; ++j) total += M[i * STRIDE + j] * shown[j];
    OF(rest, i) = total - smooth(i);
}
EACH_ROW(r) x[r] += along_row(r);
// Read the row states of the last step. They are not used after a reset, which sets the last acceleration to zero.
[[maybe_unused]] auto last_rows = [&](int k) -> int& {
    return arrays.last_rows.data[(long long)world * arrays.last_rows.shape[1] + k];
};
[[maybe_unused]] auto key_of = [&](int row) { return arrays.row_key.data[(long long)world * arrays.row_key.shape[1] + row]; };
int had = 0;  // number of rows in the last step
if (KNOWN) {
    bool moving = false;
    EACH_DOF(i) moving |= OF(a, i) != 0.0f;
    if (any(moving)) had = last_rows(0);
    int* before = reinterpret_cast<int*>(force);
    EACH(k, had) before[k] = last_rows(1 + k);
    meet();
    // Returns the last state of the k-th row after the equality rows. Looks at place k first: rows often keep their place.
    auto state_of = [&](int k) {
        const int key = key_of(ne + k);
        int place = k;
        if (k >= had || before[k] >> 2 != key) {
            place = 0;
            ROLLED for (int beyond = had; place < beyond;) {
                const int middle = (place + beyond) / 2;
                if (before[middle] >> 2 < key) place = middle + 1; else beyond = middle;
            }
            if (place >= had || before[place] >> 2 != key) return UNKNOWN;
        }
        return (before[place] & 3) - 2;
    };
    EACH_ROW(r) if (r >= ne) states[r] = state_of(efc_row(r) - ne);
    if (DRY) EACH(i, NV) if (dry_row[i] >= 0) dry_states[i] = state_of(dry_row[i] - ne);
    meet();
}
if (SPLIT) EACH_ROW(r) {
    with_row(r, [&](int r, const float* row) {
        unsigned long long moved = 0;
        int last = 0;
        BY_FOUR for (int j = 0; j < NV; ++j) if (row[j] != 0.0f) { moved |= 1ull << j; last = j; }
        couples[r] = (moved & ~arrays.path.data[last]) != 0;
    });
}
