// The constraint rows of one world, and who holds what. Constants: NV (degrees of freedom, at most 64), ROWS (most constraint
// rows), KEPT_ROWS (of the Jacobian in shared memory), STRIDE (from one row of a matrix to the next), ENTRIES (of the mass
// matrix that are not zero), FRICTION (whether there may be rows of dry friction), DRY (whether they are all of degrees of
// freedom), SPLIT (whether there are branches), ROOT (degrees of freedom before the first branch), KNOWN (whether rows are
// known again from step to step), and the sides of row_sides.py.
//
// On a GPU each lane holds what belongs to one degree of freedom or two (a row of a matrix too), in registers; what all lanes
// read often, and what belongs to constraint rows, is in shared memory. On the CPU one thread holds everything, and the same
// text is the serial solver.

#if defined(__CUDA_ARCH__)
#define EACH_DOF(i) UNROLLED for (int slot = 0; slot < DOFS; ++slot) if (const int i = dof_at(slot); i < NV)
// One after the other for each lane: worlds with more than 32 rows are few, and what is short stays in the cache of
// instructions.
#define EACH_ROW(r) ROLLED EACH(r, rows)
// All lanes take part, with r beyond the last row too, as `rank` needs it.
#define EVERY_ROW(r) ROLLED for (int first = 0; first < rows; first += 32) if (const int r = first + lane; true)
#define OF(values, i) values[slot]
const int DOFS = NV > 32 ? 2 : 1, KEPT = KEPT_ROWS;
// Which degree of freedom a lane holds. Of more than 32, those of the root are second ones: they need no row of a matrix.
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
LEGGED_SHARED float shown[STRIDE];  // a vector over degrees of freedom
LEGGED_SHARED float D[ROWS], x[ROWS], force[ROWS], curvature[ROWS];
float* jv = force;  // of a step, before there are new forces
LEGGED_SHARED signed char sides[ROWS];
LEGGED_SHARED short pushing[ROWS];  // those rows that push now
LEGGED_SHARED bool couples[ROWS];  // whether a row moves degrees of freedom of several branches
const int DRY_DOFS = DRY ? NV : 1;  // of each degree of freedom what its row of dry friction has, and which it is, or -1
LEGGED_SHARED float dry_D[DRY_DOFS], dry_loss[DRY_DOFS], dry_reference[DRY_DOFS], dry_curvature[DRY_DOFS];
LEGGED_SHARED signed char dry_sides[DRY_DOFS];
LEGGED_SHARED short dry_row[DRY_DOFS];
float a[DOFS], Ms[DOFS], grad[DOFS], s[DOFS];
float rest[DOFS];  // what constraints have to push: M a - qfrc_smooth
const float TINY = 1e-15f;

const int ne = arrays.equalities.data[world], frictions = FRICTION ? arrays.frictions.data[world] : 0;
const int of_all = arrays.nefc.data[world] < ROWS ? arrays.nefc.data[world] : ROWS;
// Rows of dry friction in degrees of freedom, one each, belong to those, and are no rows in what follows.
const int dry = DRY ? (ne + frictions < of_all ? frictions : of_all > ne ? of_all - ne : 0) : 0;
const int rows = of_all - dry, nf = ne + (DRY ? 0 : frictions);
auto efc_row = [&](int r) { return DRY && r >= ne ? r + dry : r; };
const int width = arrays.jacobian.shape[2];  // padded
// A number of row r; arrays differ in how many rows they have room for.
auto number_of = [&](const auto& array, int r) { return array.data[(long long)world * array.shape[1] + efc_row(r)]; };
const float* jacobian = arrays.jacobian.data + (long long)world * arrays.jacobian.shape[1] * width;
auto smooth = [&](int i) { return arrays.qfrc_smooth.data[world * arrays.qfrc_smooth.shape[1] + i]; };
// Calls `use(r, row)` with `row` the Jacobian's: those in shared memory and the others, in few worlds, are read differently.
auto with_row = [&](int r, auto use) {
    if (r < KEPT) use(r, static_cast<const float*>(J + r * STRIDE));
    else if (KEPT < ROWS) use(r, jacobian + (long long)efc_row(r) * width);
};
// The same of all rows that push, for all lanes.
int pushers = 0, near_pushers = 0;
auto each_pushing = [&](auto use) {
    BY_TWO for (int k = 0; k < near_pushers; ++k) use(pushing[k], static_cast<const float*>(J + pushing[k] * STRIDE));
    if (KEPT < ROWS)
        ROLLED for (int k = near_pushers; k < pushers; ++k) use(pushing[k], jacobian + (long long)efc_row(pushing[k]) * width);
};
// A row of the Jacobian times `shown`.
auto along_row = [&](int r) {
    float total = 0.0f;
    if (r < KEPT) {
        UNROLLED for (int j = 0; j < NV; ++j) total += J[r * STRIDE + j] * shown[j];
    } else if (KEPT < ROWS) {
        ROLLED for (int j = 0; j < NV; ++j) total += jacobian[(long long)efc_row(r) * width + j] * shown[j];
    }
    return total;
};

// Derivative of the cost of dry friction at x. `side` tells the pieces of the cost apart: the curvature where it is quadratic.
[[maybe_unused]] auto rub = [](float d, float loss, float at, float& side) {
    side = d;
    if (d * at > loss) { side = -1.0f; return loss; }
    if (d * at < -loss) { side = -2.0f; return -loss; }
    return d * at;
};
// The same where it is on this side, or would be.
[[maybe_unused]] auto rub_on = [](float d, float loss, float at, float& side) {
    if (side == IDLE) return 0.0f;
    if (side < IDLE) return side == SLIPPING ? loss : -loss;
    side = d;
    return d * at;
};
// The same of a row.
auto pull = [&](int r, float at, float& side) {
    const float d = D[r];
    side = d;
    if (r >= nf && at >= 0.0f) { side = 0.0f; return 0.0f; }
    if (FRICTION && !DRY && r >= ne && r < nf) return rub(d, number_of(arrays.frictionloss, r), at, side);
    return d * at;
};

meet();  // of the world before
if (DRY) EACH(i, NV) {
    dry_row[i] = -1;
    dry_D[i] = dry_loss[i] = dry_reference[i] = dry_curvature[i] = 0.0f;
    dry_sides[i] = UNKNOWN;
}
ROLLED EACH(k, NV * STRIDE) M[k] = 0.0f;
#if defined(__CUDA_ARCH__)
{
    struct alignas(16) Four { float of[4]; };  // a row is padded to whole ones
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
    sides[r] = UNKNOWN;
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
// The sides of the last step, but after a reset, which leaves no acceleration to begin with.
[[maybe_unused]] auto last_rows = [&](int k) -> int& {
    return arrays.last_rows.data[(long long)world * arrays.last_rows.shape[1] + k];
};
[[maybe_unused]] auto key_of = [&](int row) { return arrays.row_key.data[(long long)world * arrays.row_key.shape[1] + row]; };
int had = 0;  // rows in the last step
if (KNOWN) {
    bool moving = false;
    EACH_DOF(i) moving |= OF(a, i) != 0.0f;
    if (any(moving)) had = last_rows(0);
    int* before = reinterpret_cast<int*>(force);
    EACH(k, had) before[k] = last_rows(1 + k);
    meet();
    // Of the k-th row after equalities; it often has the place that it had.
    auto side_of = [&](int k) {
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
    EACH_ROW(r) if (r >= ne) sides[r] = side_of(efc_row(r) - ne);
    if (DRY) EACH(i, NV) if (dry_row[i] >= 0) dry_sides[i] = side_of(dry_row[i] - ne);
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
