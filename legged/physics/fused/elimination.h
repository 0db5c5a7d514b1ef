// Solution of a system H s = g over the degrees of freedom of a tree, by Cholesky's method from the leaves to the root
// (Featherstone, Rigid Body Dynamics Algorithms, 2008, section 6.5). If no constraint row couples branches, H couples a
// degree of freedom only with those on its path to the root. A row of H is then as short as the path, and all degrees of
// freedom of the same depth are eliminated at once. Otherwise the tree is treated as a single path.
//
// The first ROOT degrees of freedom are the root. All others are called limbs. The entries of the root's block of H and of
// its part of g are called corners. Constants: ROOT (degrees of freedom that all paths begin with, at most 6), DEPTH (largest
// length of a path), WIDTH (largest number of limbs of the same depth), SPLIT (the tree has branches), TRIANGLE (number of
// the root's entries of H) and CORNER (number of the root's entries of H and g).

#if defined(__CUDA_ARCH__)
#define UNROLLED_ALONG _Pragma("unroll turns")
#define EVERY_LIMB(i) UNROLLED for (int slot = 0; slot < LIMBS; ++slot) if (const int i = dof_at(slot); true)
#define EACH_LIMB(i) EVERY_LIMB(i) if (i >= ROOT && i < NV)
#define EVERY_CORNER(n) if (const int n = lane; true)
#define EACH_CORNER(n) EVERY_CORNER(n) if (n < CORNER)
#define OF_CORNER(values, n) values[0]
const int LIMBS = NV > 32 && NV - ROOT > 32 ? 2 : 1, CORNERS = 1;
// `from_corner` returns the value of the lane that has corner n, `from_limb` that of the lane that has limb i.
auto from_corner = [&](const float* values, int n) { return __shfl_sync(0xffffffffu, values[0], n); };
auto from_limb = [&](const float* values, int i) {
    if (NV <= 32) return __shfl_sync(0xffffffffu, values[0], i);
    const float one = __shfl_sync(0xffffffffu, values[0], (i - ROOT) & 31);
    if (LIMBS == 1) return one;
    const float other = __shfl_sync(0xffffffffu, values[LIMBS - 1], i & 31);
    return i < ROOT + 32 ? one : other;
};
#else
#define UNROLLED_ALONG
#define EVERY_LIMB(i) for (int i = ROOT; i < NV; ++i)
#define EACH_LIMB(i) EVERY_LIMB(i)
#define EVERY_CORNER(n) for (int n = 0; n < CORNER; ++n)
#define EACH_CORNER(n) EVERY_CORNER(n)
#define OF_CORNER(values, n) values[n]
const int LIMBS = NV, CORNERS = CORNER > 0 ? CORNER : 1;
auto from_corner = [&](const float* values, int n) { return values[n]; };
auto from_limb = [&](const float* values, int i) { return values[i]; };
#endif
const int CHAIN = DEPTH > ROOT ? DEPTH - ROOT : 1, PITCH = 4 * ((DEPTH + 4) / 4), LONG_PITCH = 4 * ((NV + 4) / 4);
const int BOARD = SPLIT && WIDTH * PITCH < LONG_PITCH ? LONG_PITCH : WIDTH * PITCH;
LEGGED_SHARED float boards[2 * BOARD];
struct Branches { enum { value = 1 }; };
struct Path { enum { value = 0 }; };

// For each limb: its depth, its place among those of the same depth, and the degree of freedom at each depth of its path.
int depth_of[LIMBS] = {}, place_of[LIMBS] = {}, path_of[LIMBS][CHAIN] = {};
EACH_LIMB(i) {
    OF(depth_of, i) = SPLIT ? arrays.dof_depth.data[i] : i;
    OF(place_of, i) = SPLIT ? arrays.dof_place.data[i] : 0;
    UNROLLED for (int t = ROOT; t < DEPTH; ++t) OF(path_of, i)[t - ROOT] = SPLIT ? arrays.dof_path.data[t * NV + i] : t;
}
// For each corner: its row and its column; -1 is the column of the right-hand side.
int row_of[CORNERS] = {}, column_of[CORNERS] = {};
EACH_CORNER(n) {
    int i = 0;
    while ((i + 1) * (i + 2) / 2 <= n) ++i;
    OF_CORNER(row_of, n) = n < TRIANGLE ? i : n - TRIANGLE;
    OF_CORNER(column_of, n) = n < TRIANGLE ? n - i * (i + 1) / 2 : -1;
}

bool several = false;  // true if a row couples branches
// With dampers, one more system is solved after the last iteration, by the same code: (M + h D) a = all forces. Its solution
// is the acceleration that integrates the velocities, with dampers that act at the end of the step (MuJoCo's Euler).
bool advancing = false;
// Replaces the right-hand side in s and `shown` by the solution. All lanes can read the solution in `shown`.
auto solve = [&](auto tree) {
    constexpr bool branches = decltype(tree)::value;
    constexpr int height = branches ? DEPTH : NV, pitch = branches ? PITCH : LONG_PITCH;
    // Few worlds have a row that couples branches. For these, loops are not unrolled and H is in slow memory: in registers,
    // H's long rows would displace data that every world needs.
    [[maybe_unused]] constexpr int turns = branches || !SPLIT ? height : 1;
    float H[LIMBS][height], over[LIMBS], C[CORNERS] = {};
    // Compute the Hessian M + J^T diag(curvature) J, or M + h D.
    EACH_LIMB(i) {
        UNROLLED_ALONG for (int e = 0; e < height; ++e)
            OF(H, i)[e] = M[i * STRIDE + (branches && e >= ROOT ? OF(path_of, i)[e - ROOT] : e)];
    }
    EACH_CORNER(n) {
        const int i = OF_CORNER(row_of, n), j = OF_CORNER(column_of, n);
        OF_CORNER(C, n) = j < 0 ? shown[i] : M[i * STRIDE + j];
    }
    if (!(DAMPED && advancing)) each_pushing([&](int r, const float* row) {
        const float weight = curvature[r];
        EACH_LIMB(i) {
            const float part = weight * row[i];
            UNROLLED_ALONG for (int e = 0; e < height; ++e)
                OF(H, i)[e] += part * row[branches && e >= ROOT ? OF(path_of, i)[e - ROOT] : e];
        }
        EACH_CORNER(n) {
            const int i = OF_CORNER(row_of, n), j = OF_CORNER(column_of, n);
            if (j >= 0) OF_CORNER(C, n) += weight * row[i] * row[j];
        }
        if (ELLIPTIC && directions[r] > 0 && bent[r] != 0.0f) {
            EACH_LIMB(i) {
                UNROLLED_ALONG for (int e = 0; e < height; ++e)
                    OF(H, i)[e] += bend_of(r, i, branches && e >= ROOT ? OF(path_of, i)[e - ROOT] : e);
            }
            EACH_CORNER(n) {
                const int i = OF_CORNER(row_of, n), j = OF_CORNER(column_of, n);
                if (j >= 0) OF_CORNER(C, n) += bend_of(r, i, j);
            }
        }
    });
    if (DRY && !(DAMPED && advancing)) {
        EACH_LIMB(i) {
            UNROLLED_ALONG for (int e = ROOT; e < height; ++e)
                OF(H, i)[e] += e == (branches ? OF(depth_of, i) : i) ? dry_curvature[i] : 0.0f;
        }
        EACH_CORNER(n) {
            const int i = OF_CORNER(row_of, n);
            if (i == OF_CORNER(column_of, n)) OF_CORNER(C, n) += dry_curvature[i];
        }
    }
    if (DAMPED && advancing) {
        const float h = arrays.timestep.data[world % arrays.timestep.shape[0]];
        const float* damping = arrays.damping.data + (long long)(world % arrays.damping.shape[0]) * NV;
        EACH_LIMB(i) {
            UNROLLED_ALONG for (int e = ROOT; e < height; ++e)
                OF(H, i)[e] += e == (branches ? OF(depth_of, i) : i) ? h * damping[i] : 0.0f;
        }
        EACH_CORNER(n) {
            const int i = OF_CORNER(row_of, n);
            if (i == OF_CORNER(column_of, n)) OF_CORNER(C, n) += h * damping[i];
        }
    }
    // Eliminate limbs from the leaves to the root: H = L^T diag(1 / over) L. A row of the board holds the right-hand side,
    // `over`, and the row of H.
    UNROLLED_ALONG for (int t = height - 1; t >= ROOT; --t) {
        float* board = boards + (t & 1) * BOARD;
        EACH_LIMB(i) {
            // Every lane reads the pivot. Otherwise the compiler indexes H by depth, and H cannot stay in registers.
            const float pivot = OF(H, i)[t];
            if ((branches ? OF(depth_of, i) : i) == t) {
                float* row = board + (branches ? OF(place_of, i) * pitch : 0);
                row[0] = OF(s, i);
                row[1] = OF(over, i) = inverse(most(pivot, TINY));
                UNROLLED_ALONG for (int e = 0; e < height; ++e) if (e < t) row[2 + e] = OF(H, i)[e];
            }
        }
        meet();
        EACH_LIMB(i) {
            const int own = branches ? OF(depth_of, i) : i;
            if (own < t) {
                int from = 0, to = 1;
                if (branches) {
                    const int packed = arrays.below.data[t * NV + i];  // places of i's descendants at this depth
                    from = packed & 0xff, to = packed >> 8;
                }
                ROLLED for (int n = from; n < to; ++n) {
                    const float* row = board + n * pitch;
                    const float part = row[2 + own] * row[1];
                    UNROLLED_ALONG for (int e = 0; e < height; ++e) if (e < t) OF(H, i)[e] -= part * row[2 + e];
                    OF(s, i) -= part * row[0];
                }
            }
        }
        EACH_CORNER(n) {
            const int i = OF_CORNER(row_of, n), j = OF_CORNER(column_of, n), count = branches ? arrays.depth_width.data[t] : 1;
            BY_TWO for (int k = 0; k < count; ++k) {
                const float* row = board + k * pitch;
                OF_CORNER(C, n) -= row[1] * row[2 + i] * row[j < 0 ? 0 : 2 + j];
            }
        }
    }
    // Factorise the root, of which each lane has one corner, by the same formula. Then compute its solution in all lanes.
    float root[ROOT > 0 ? ROOT : 1], root_over[ROOT > 0 ? ROOT : 1];
    meet();  // wait until all lanes have read `shown`, which is written below
    UNROLLED for (int k = ROOT - 1; k >= 0; --k) {
        const int row = k * (k + 1) / 2;
        root_over[k] = inverse(most(from_corner(C, row + k), TINY));
        EVERY_CORNER(n) {
            const int i = OF_CORNER(row_of, n), j = OF_CORNER(column_of, n);
            const float one = from_corner(C, i < k ? row + i : 0);
            const float other = from_corner(C, j < 0 ? TRIANGLE + k : j < k ? row + j : 0);
            if (i < k) OF_CORNER(C, n) -= one * root_over[k] * other;
        }
    }
    UNROLLED for (int k = 0; k < ROOT; ++k) {
        root[k] = from_corner(C, TRIANGLE + k) * root_over[k];
        EVERY_CORNER(n) {
            const int i = OF_CORNER(row_of, n);
            const float part = from_corner(C, i > k ? i * (i + 1) / 2 + k : 0);
            if (OF_CORNER(column_of, n) < 0 && i > k) OF_CORNER(C, n) -= part * root[k];
        }
        if (lane == 0) shown[k] = root[k];
    }
    // Substitute back from the root to the leaves.
    EACH_LIMB(i) {
        UNROLLED_ALONG for (int e = 0; e < ROOT; ++e) OF(s, i) -= OF(H, i)[e] * root[e];
    }
    UNROLLED_ALONG for (int t = ROOT; t < height; ++t) {
        EACH_LIMB(i) {
            if ((branches ? OF(depth_of, i) : i) == t) OF(s, i) *= OF(over, i);
        }
        EVERY_LIMB(i) {
            const float known = from_limb(s, branches ? OF(path_of, i)[t - ROOT] : t);
            if (i >= ROOT && i < NV && (branches ? OF(depth_of, i) : i) > t) OF(s, i) -= OF(H, i)[t] * known;
        }
    }
    EACH_LIMB(i) shown[i] = OF(s, i);
    meet();
    EACH_DOF(i) OF(s, i) = shown[i];
};
