// Whether neighbour (d, i) comes before (e, j): nearer, or as near with a lower index.
__device__ __forceinline__ bool before(double d, int i, double e, int j) { return d < e || (d == e && i < j); }

// Squared distance to a box. Each step rounds monotonically, in the order in which the distance to a point is summed.
// So it never exceeds the computed distance to a point inside, and skipping boxes by it loses no neighbour and no tie.
__device__ __forceinline__ double box_distance(const REAL* boxes, int node, double x, double y, double z) {
    const REAL* box = boxes + 6 * (long long)node;
    const double below_x = box[0] - x, above_x = x - box[3];
    const double below_y = box[1] - y, above_y = y - box[4];
    const double below_z = box[2] - z, above_z = z - box[5];
    const double dx = below_x > 0 ? below_x : above_x > 0 ? above_x : 0.0;
    const double dy = below_y > 0 ? below_y : above_y > 0 ? above_y : 0.0;
    const double dz = below_z > 0 ? below_z : above_z > 0 ? above_z : 0.0;
    return dx * dx + dy * dy + dz * dz;
}

extern "C" __global__ void nearest(const REAL* __restrict__ points, const int* __restrict__ order,
                                   const REAL* __restrict__ boxes, const int* __restrict__ lowest, int n, int depth,
                                   double infinity, long long* __restrict__ indices,
                                   REAL* __restrict__ distances) {
    const int self = blockIdx.x * blockDim.x + threadIdx.x;
    if (self >= n) return;
    const double x = points[3 * (long long)self], y = points[3 * (long long)self + 1],
                 z = points[3 * (long long)self + 2];

    double best[K];  // ascending, squared
    int which[K];
#pragma unroll
    for (int s = 0; s < K; ++s) {
        best[s] = infinity;
        which[s] = -1;
    }

    // The stack holds the sibling of every node from the root to the own leaf, the nearest relatives on top. The search
    // starts in the own leaf, which fills the list with close points; most of the rest of the tree is skipped.
    const int leaves = 1 << depth;
    const int home = leaves + (int)(((self + 1LL) * leaves - 1) / n);
    int waiting[32];
    double away[32];
    int top = 0;
    for (int level = depth - 1; level >= 0; --level) {
        waiting[top] = (home >> level) ^ 1;
        away[top] = box_distance(boxes, waiting[top], x, y, z);
        ++top;
    }

    for (int node = home; node;) {
        while (node && node < leaves) {
            int near = 2 * node, far = near + 1;
            double to_near = box_distance(boxes, near, x, y, z), to_far = box_distance(boxes, far, x, y, z);
            if (before(to_far, lowest[far], to_near, lowest[near])) {
                const int swapped = near;
                const double to_swapped = to_near;
                near = far, to_near = to_far;
                far = swapped, to_far = to_swapped;
            }
            if (before(to_far, lowest[far], best[K - 1], which[K - 1])) {
                waiting[top] = far;
                away[top] = to_far;
                ++top;
            }
            node = before(to_near, lowest[near], best[K - 1], which[K - 1]) ? near : 0;
        }
        if (node) {
            const int begin = (int)((long long)(node - leaves) * n / leaves);
            const int end = (int)((node - leaves + 1LL) * n / leaves);
            for (int p = begin; p < end; ++p) {
                const double dx = points[3 * (long long)p] - x, dy = points[3 * (long long)p + 1] - y,
                             dz = points[3 * (long long)p + 2] - z;
                const double d = dx * dx + dy * dy + dz * dz;
                const int i = order[p];
                if (p == self || !before(d, i, best[K - 1], which[K - 1])) continue;
#pragma unroll
                for (int s = K - 1; s > 0; --s) {
                    if (before(d, i, best[s - 1], which[s - 1])) {
                        best[s] = best[s - 1];
                        which[s] = which[s - 1];
                    } else if (before(d, i, best[s], which[s])) {
                        best[s] = d;
                        which[s] = i;
                    }
                }
                if (before(d, i, best[0], which[0])) {
                    best[0] = d;
                    which[0] = i;
                }
            }
        }
        // A node as far as the last neighbour is visited if it holds a lower index: ties go to the lower index.
        node = 0;
        while (top && !node) {
            --top;
            if (before(away[top], lowest[waiting[top]], best[K - 1], which[K - 1])) node = waiting[top];
        }
    }

    const int own = order[self];
    const long long row = (long long)own * K;
#pragma unroll
    for (int s = 0; s < K; ++s) {
        indices[row + s] = which[s];
        distances[row + s] = (REAL)sqrt(best[s]);
    }
}
