// The body of solve. Names in capital letters are sizes, and whether memory is SHARED: macros of _make_solve_kernel.

#define INLINE __attribute__((always_inline))
const int parts = PARTS, width = matrix.width, blocks = SHARED ? 1 : team.blocks;
const int first = unknowns.of_worlds.data[world], rows = unknowns.of_worlds.data[world + 1] - first;
const int* is_free = unknowns.is_free.data + first;
const int first_coupled = contacts.coupled_first.data[world];
const int coupled = contacts.coupled_end.data[world] - first_coupled;
float* pulls = (float*)(contacts.pull.data + first_coupled);
float* solution = (float*)(vectors.solution.data + first);
float* residual = (float*)(vectors.residual.data + first);
float* product = (float*)(vectors.product.data + first);
float* direction = (float*)(vectors.direction.data + first);
float* along = (float*)(vectors.along.data + first);
#if defined(__CUDA_ARCH__)
#if SHARED
__shared__ __align__(16) float preconditioned[WIDE * THREADS];
#else
float* preconditioned = (float*)(vectors.preconditioned.data + first);
#endif
__shared__ float shared_inverses[INVERSES + 1], sums_of_warps[2][32], sums_of_blocks[2];
// of the first contacts that couple; blocks are symmetric, entries those of rows, as four times the contact plus
// the place
__shared__ float shared_pulls[3 * COUPLED], coupled_blocks[6 * COUPLED];
__shared__ float4 coupled_weights[COUPLED];
__shared__ ushort4 coupled_columns[COUPLED];
__shared__ unsigned short coupled_entries[4 * COUPLED];
__shared__ int entries;
typedef float real;
const int lane = threadIdx.x, threads = blockDim.x;
const int shared = SHARED && unknowns.particle.data[first + rows - 1] >= 0 ? wp::min(coupled, COUPLED) : 0;
auto quotient = [](float a, float b) { return __fdividef(a, b); };
auto multiplied = [&](int at) INLINE {  // read at once
#if SHARED
    const float4 all = *(const float4*)(preconditioned + at);
    return wp::vec3(all.x, all.y, all.z);
#else
    return wp::vec3(preconditioned[at], preconditioned[at + 1], preconditioned[at + 2]);
#endif
};
int turn = 0;
auto wait = [&]() {
    __syncthreads();
    if (blocks > 1) {
        if (lane == 0) {
            __threadfence();
            atomicAdd(&team.arrived.data[world], 1);
            while (*(volatile int*)&team.arrived.data[world] < (turn + 1) * blocks) {
            }
            __threadfence();
        }
        ++turn;
        __syncthreads();
    }
};
// in single precision: a sum of a tree of warps is as good as its terms; threads wait between two sums
auto sum = [&](float& a, float& b) INLINE {
    for (int offset = 16; offset; offset >>= 1) {
        a += __shfl_xor_sync(~0u, a, offset);
        b += __shfl_xor_sync(~0u, b, offset);
    }
    if ((lane & 31) == 0) {
        sums_of_warps[0][lane >> 5] = a;
        sums_of_warps[1][lane >> 5] = b;
    }
    __syncthreads();
    a = b = 0.0f;
#pragma unroll
    for (int warp = 0; warp < THREADS / 32; ++warp) {  // 0 of those that do not run
        a += sums_of_warps[0][warp];
        b += sums_of_warps[1][warp];
    }
    if (blocks == 1)
        return;
    volatile float* of_blocks = team.sums.data + 2 * world * blocks;
    if (lane == 0) {
        of_blocks[2 * block] = a;
        of_blocks[2 * block + 1] = b;
    }
    wait();
    if (lane < 32) {
        a = b = 0.0f;
        for (int other = lane; other < blocks; other += 32) {
            a += of_blocks[2 * other];
            b += of_blocks[2 * other + 1];
        }
        for (int offset = 16; offset; offset >>= 1) {
            a += __shfl_xor_sync(~0u, a, offset);
            b += __shfl_xor_sync(~0u, b, offset);
        }
        if (lane == 0)
            sums_of_blocks[0] = a, sums_of_blocks[1] = b;
    }
    __syncthreads();
    a = sums_of_blocks[0], b = sums_of_blocks[1];
};
const unsigned sharers = (parts == 32 ? ~0u : (1u << parts) - 1u) << (lane & 31 & ~(parts - 1));
auto sum_of_parts = [&](float value) INLINE {
    for (int offset = parts / 2; offset; offset >>= 1)
        value += __shfl_xor_sync(sharers, value, offset);
    return value;
};
if (lane < 64)
    sums_of_warps[lane / 32][lane % 32] = 0.0f;
if (shared) {
    for (int n = lane; n < shared; n += threads) {
        const int i = contacts.coupled.data[first_coupled + n];
        unsigned short columns[4];
        float weights[4];
        for (int j = 0; j < 4; ++j) {
            const int u = contacts.coupled_unknowns.data[first_coupled + n][j];
            columns[j] = u < 0 ? 0 : WIDE * (u - first);
            weights[j] = u < 0 ? 0.0f : contacts.weights.data[i][j];
        }
        coupled_columns[n] = make_ushort4(columns[0], columns[1], columns[2], columns[3]);
        coupled_weights[n] = make_float4(weights[0], weights[1], weights[2], weights[3]);
        const float* h = (float*)&contacts.hessian.data[i];
        const int places[6] = {0, 5, 10, 1, 2, 6};  // of the diagonal, and above it
        for (int c = 0; c < 6; ++c)
            coupled_blocks[c * COUPLED + n] = h[places[c]];
    }
    if (lane == 0)
        entries = 0;
    __syncthreads();
}
#else
const int lane = 0, threads = 1;
float* preconditioned = (float*)(vectors.preconditioned.data + first);
const int shared = 0;
auto wait = []() {};
auto quotient = [](double a, double b) { return a / b; };
auto multiplied = [&](int at) { return wp::vec3(); };
auto sum = [](double, double) {};
typedef double real;
auto sum_of_parts = [](float value) { return value; };
#endif
const int part = lane % parts, stride = blocks * threads / parts, begin = (block * threads + lane) / parts;
// a thread with one row has what it needs of it in registers: also some blocks
const bool keeps = KEPT > 0 && (SHARED || rows <= stride);
wp::vec3 own_x, own_r, own_w, own_p, own_s;
auto vector_of = [](const float* all, int at) { return wp::vec3(all[at], all[at + 1], all[at + 2]); };
auto get = [&](const wp::vec3& own, const float* all, int row) { return keeps ? own : vector_of(all, 3 * row); };
auto put = [&](wp::vec3& own, float* all, int row, const wp::vec3& value) {
    if (keeps)
        own = value;
    else
        for (int c = 0; c < 3; ++c)
            all[3 * row + c] = value[c];
};
auto precondition = [&](int row, const wp::vec3& r) {
#if defined(__CUDA_ARCH__)
    if (INVERSES) {
        wp::vec3 z;
        for (int k = 0; k < 9; ++k)
            z[k / 3] += shared_inverses[k * THREADS + lane] * r[k % 3];
        return z;
    }
#endif
    return wp::mul(vectors.inverse.data[first + row], r);
};
const int* first_entries = matrix.first.data + matrix.group.data[world];
auto first_entry = [&](int row) { return first_entries + (row * parts + part) / width; };
const int of_group = (begin * parts + part) % width;  // so it is for all rows of the thread
float kept[KEPT + 1][9];
int kept_column[KEPT + 1], own_entry = 0, own_end = 0;
bool own_free = false;
int own_first = 0, own_count = 0;  // of its contacts in shared memory
if (keeps && begin < rows) {
    own_free = is_free[begin];
#if defined(__CUDA_ARCH__)
    for (int c = 0; c < INVERSES / THREADS; ++c)
        shared_inverses[c * THREADS + lane] = ((float*)&vectors.inverse.data[first + begin])[c];
#endif
    own_entry = first_entry(begin)[0], own_end = first_entry(begin)[1];
#pragma unroll
    for (int k = 0; k < KEPT; ++k) {
        const int at = (own_entry + k) * width + of_group;
        const int column = own_entry + k < own_end ? matrix.column.data[at] : -1;
        kept_column[k] = column < 0 ? 0 : WIDE * (column - first);
        for (int c = 0; c < 9; ++c)
            kept[k][c] = column < 0 ? 0.0f : matrix.value.data[9 * (at - of_group) + c * width + of_group];
    }
    own_entry += KEPT;
}
#if defined(__CUDA_ARCH__)
if (shared && begin < rows) {
    const int middle = contacts.middle.data[first + begin] + part, end = contacts.end.data[first + begin];
    for (int n = middle; n < end; n += parts)
        own_count += contacts.pulled.data[n] < shared;
    own_first = own_count ? atomicAdd(&entries, own_count) : 0;
    for (int n = middle, at = own_first; n < end; n += parts)
        if (contacts.pulled.data[n] < shared)
            coupled_entries[at++] = 4 * contacts.pulled.data[n] + (contacts.entries.data[n] & 3);
}
#endif
auto pull = [&]() INLINE {  // products of contacts that couple with what is multiplied
    if (coupled == 0)
        return;
#if defined(__CUDA_ARCH__)
    for (int n = lane; n < shared; n += threads) {
        const ushort4 at = coupled_columns[n];
        const float4 by = coupled_weights[n];
        const float* h = coupled_blocks + n;
        const wp::vec3 apart =
            by.x * multiplied(at.x) + by.y * multiplied(at.y) + by.z * multiplied(at.z) + by.w * multiplied(at.w);
        const float xy = h[3 * COUPLED], xz = h[4 * COUPLED], yz = h[5 * COUPLED];
        shared_pulls[3 * n] = h[0] * apart[0] + xy * apart[1] + xz * apart[2];
        shared_pulls[3 * n + 1] = xy * apart[0] + h[COUPLED] * apart[1] + yz * apart[2];
        shared_pulls[3 * n + 2] = xz * apart[0] + yz * apart[1] + h[2 * COUPLED] * apart[2];
    }
#endif
    for (int n = shared + block * threads + lane; n < coupled; n += blocks * threads) {
        const int i = contacts.coupled.data[first_coupled + n];
        const wp::vec4i corners = contacts.coupled_unknowns.data[first_coupled + n];
        const wp::vec4 weights = contacts.weights.data[i];
        wp::vec3 apart;
        for (int j = 0; j < 4; ++j) {
            const int u = corners[j];
            const float* d = preconditioned + WIDE * (u >= 0 ? u - first : u < -1 ? -2 - u - first : 0);
            const float weight = u == -1 ? 0.0f : weights[j];
            apart += weight * vector_of(d, 0);
            if (u < -1)  // of a body: its turn follows its shift
                apart += weight * wp::cross(vector_of(d, WIDE), unknowns.arm.data[contacts.corners.data[i][j]]);
        }
        const auto& h = contacts.hessian.data[i].data;
        for (int c = 0; c < 3; ++c)
            pulls[3 * n + c] = h[c][0] * apart[0] + h[c][1] * apart[1] + h[c][2] * apart[2];
    }
    wait();
};
auto multiply = [&](int row) INLINE {
    const int u = first + row;
    wp::vec3 total;
    int entry = own_entry, end = own_end;
    if (keeps) {
#pragma unroll
        for (int k = 0; k < KEPT; ++k) {
            const wp::vec3 d = multiplied(kept_column[k]);
            for (int c = 0; c < 9; ++c)
                total[c % 3] = fmaf(kept[k][3 * (c % 3) + c / 3], d[c / 3], total[c % 3]);
        }
    } else {
        entry = first_entry(row)[0];
        end = first_entry(row)[1];
    }
    const float* v = matrix.value.data + 9 * entry * width + of_group;
    for (; entry < end; ++entry, v += 9 * width) {
        const int column = matrix.column.data[entry * width + of_group];
        if (column < 0)
            break;
        const float* d = preconditioned + WIDE * (column - first);
        for (int c = 0; c < 3; ++c)
            total[c] += v[3 * c * width] * d[0] + v[(3 * c + 1) * width] * d[1] + v[(3 * c + 2) * width] * d[2];
    }
#if defined(__CUDA_ARCH__)
    // not unrolled where blocks are kept: with more code here, they are in local memory instead of registers
#pragma unroll 1
    for (int n = own_first; n < own_first + own_count; ++n) {
        const int at = coupled_entries[n];
        const float weight = ((float*)coupled_weights)[at];
        for (int c = 0; c < 3; ++c)
            total[c] += weight * shared_pulls[3 * (at >> 2) + c];
    }
#endif
    if (coupled > shared) {
        const bool of_body = unknowns.particle.data[u] < 0;
        const int end = contacts.end.data[u];
#pragma unroll UNROLLED
        for (int n = contacts.middle.data[u] + part; n < end; n += parts) {
            const int at = contacts.pulled.data[n];
            if (at < shared)
                continue;
            const float* by = pulls + 3 * at;
            const float weight = contacts.entry_weight.data[n];
            wp::vec3 force(weight * by[0], weight * by[1], weight * by[2]);
            if (of_body) {
                const int entry = contacts.entries.data[n];
                const int vertex = contacts.corners.data[entry >> 2][entry & 3];
                if (unknowns.of_vertex.data[vertex] == -1 - u)
                    force = wp::cross(unknowns.arm.data[vertex], force);
            }
            total += force;
        }
    }
    for (int c = 0; c < 3; ++c)
        total[c] = sum_of_parts(total[c]);
    return total;
};
for (int row = begin; row < rows; row += stride) {
    if (part)
        continue;
    const wp::vec3 x = vectors.solution.data[first + row];
    if (keeps)
        own_x = x;
    put(own_p, direction, row, wp::vec3());
    put(own_s, along, row, wp::vec3());
    for (int c = 0; c < 3; ++c)
        preconditioned[WIDE * row + c] = x[c];
}
real before = 0.0f, limit = 0.0f, curvature = 0.0f;
int count = -1;
while (true) {
    wait();
    pull();
    real squared = 0.0f, of_product = 0.0f;
    for (int row = begin; row < rows; row += stride) {
        if (!(keeps ? own_free : is_free[row]))
            continue;
        const wp::vec3 w = multiply(row);
        if (part)
            continue;
        put(own_w, product, row, w);
        if (count < 0)
            continue;
        const wp::vec3 r = get(own_r, residual, row), z = vector_of(preconditioned, WIDE * row);
        squared += wp::dot(r, z);
        of_product += wp::dot(w, z);
    }
    if (count < 0) {  // the first product is that of the solution so far, for the residual
        count = 0;
        wait();
        for (int row = begin; row < rows; row += stride) {
            if (part)
                continue;
            wp::vec3 r;
            if (is_free[row])
                r = -vectors.gradient.data[first + row] - get(own_w, product, row);
            const wp::vec3 z = precondition(row, r);
            put(own_r, residual, row, r);
            for (int c = 0; c < 3; ++c)
                preconditioned[WIDE * row + c] = z[c];
        }
        continue;
    }
    sum(squared, of_product);
    if (count == 0) {
        limit = tolerance * tolerance * squared;
        if (solves.data[world] == 0)
            team.limit.data[world] = (float)limit;
        else
            limit = wp::min(wp::max(limit, (real)team.limit.data[world]), (real)AGAIN * squared);
    }
    if (!(squared > limit))
        break;
    const real momentum = count == 0 ? (real)0.0f : quotient(squared, before);
    curvature = of_product - momentum * momentum * curvature;
    const bool is_convex = curvature > 0.0f;
    if (!is_convex && count > 0)
        break;
    const real bend = is_convex ? curvature : wp::max(-curvature, (real)1e-30f + (real)0.01f * squared);
    const float step = (float)quotient(squared, bend), again = (float)momentum;
    before = squared;
    ++count;
    for (int row = begin; row < rows; row += stride) {
        if (!(keeps ? own_free : is_free[row]) || part)
            continue;
        const wp::vec3 p = vector_of(preconditioned, WIDE * row) + again * get(own_p, direction, row);
        const wp::vec3 s = get(own_w, product, row) + again * get(own_s, along, row);
        const wp::vec3 r = get(own_r, residual, row) - step * s;
        const wp::vec3 z = precondition(row, r);
        put(own_x, solution, row, get(own_x, solution, row) + step * p);
        put(own_r, residual, row, r);
        put(own_p, direction, row, p);
        put(own_s, along, row, s);
        for (int c = 0; c < 3; ++c)
            preconditioned[WIDE * row + c] = z[c];
    }
    if (!is_convex || count == max_iterations)
        break;
}
if (keeps && part == 0 && begin < rows && own_free)
    vectors.solution.data[first + begin] = own_x;
return count;
