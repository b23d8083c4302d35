// The product of two wide integers, modulo 2 to the width of ret_type.

const auto multiply = [](const auto& x, const auto& y, wp::uint64* p) {
    constexpr int A = sizeof(x) / 8, B = sizeof(y) / 8, R = sizeof(ret_type) / 8;
    for (int i = 0; i < R; ++i)
        p[i] = 0;
#if !defined(__CUDA_ARCH__)
    if constexpr (A == 4 && B == 4) {
        const auto is_short = [](const auto& a) { return a[2] == 0 - (a[1] >> 63) && a[3] == a[2]; };
        if (is_short(x) && is_short(y)) {  // as nearly all are
            typedef unsigned __int128 Wide;
            const Wide a = (Wide)x[1] << 64 | x[0], b = (Wide)y[1] << 64 | y[0];
            const Wide low = (Wide)x[0] * y[0], one = (Wide)x[0] * y[1] + (low >> 64);
            const Wide other = (Wide)x[1] * y[0] + (wp::uint64)one, outer = (one >> 64) + (other >> 64);
            const Wide high = (Wide)x[1] * y[1] + outer - (x[1] >> 63 ? b : 0) - (y[1] >> 63 ? a : 0);
            p[0] = (wp::uint64)low, p[1] = (wp::uint64)other, p[2] = (wp::uint64)high;
            for (int i = 3; i < R; ++i)
                p[i] = i == 3 ? (wp::uint64)(high >> 64) : 0 - (p[3] >> 63);
            return;
        }
    }
    if constexpr (A * B >= 64) {
        // only the limbs that are not zero, of absolute values: most numbers are much narrower than their type
        struct Limbs {
            wp::uint64 of[A > B ? A : B];
            int low, high;
        };
        const auto magnitude = [](const auto& a, Limbs& to) -> wp::uint64 {
            constexpr int N = sizeof(a) / 8;
            const wp::uint64 mask = 0 - (a[N - 1] >> 63);
            wp::uint64 carry = mask & 1;
            to.low = N, to.high = 0;
            for (int i = 0; i < N; ++i) {
                to.of[i] = (a[i] ^ mask) + carry;
                carry &= to.of[i] == 0;
                if (to.of[i] != 0) {
                    to.low = to.low < i ? to.low : i;
                    to.high = i + 1;
                }
            }
            return mask;
        };
        Limbs a, b;
        const wp::uint64 negative = magnitude(x, a) ^ magnitude(y, b);
        if (a.high == 0 || b.high == 0)
            return;
        for (int i = a.low; i < a.high; ++i) {
            unsigned __int128 sum = 0;
            int j = b.low;
            for (; j < b.high && i + j < R; ++j) {
                sum = (unsigned __int128)a.of[i] * b.of[j] + p[i + j] + (wp::uint64)(sum >> 64);
                p[i + j] = (wp::uint64)sum;
            }
            if (i + j < R)
                p[i + j] = (wp::uint64)(sum >> 64);
        }
        if (negative) {
            wp::uint64 carry = 1;
            for (int i = 0; i < R; ++i) {
                p[i] = ~p[i] + carry;
                carry &= p[i] == 0;
            }
        }
        return;
    }
#endif
    // small ones without loops: an index that varies would put them into local memory on a GPU
    constexpr bool small = A * B <= 64;
#pragma unroll(small ? A : 1)
    for (int i = 0; i < A; ++i) {
        wp::uint64 carry = 0;
#pragma unroll(small ? B : 1)
        for (int j = 0; j < B; ++j) {
            if (i + j >= R)
                break;
#if defined(__CUDA_ARCH__)
            wp::uint64 low = x[i] * y[j];
            wp::uint64 high = __umul64hi(x[i], y[j]);
            low += carry;
            high += low < carry;
            low += p[i + j];
            high += low < p[i + j];
            p[i + j] = low;
            carry = high;
#else
            const unsigned __int128 sum = (unsigned __int128)x[i] * y[j] + p[i + j] + carry;
            p[i + j] = (wp::uint64)sum;
            carry = (wp::uint64)(sum >> 64);
#endif
        }
        if (i + B < R)
            p[i + B] = carry;
    }
    const wp::uint64 x_mask = 0 - (x[A - 1] >> 63), y_mask = 0 - (y[B - 1] >> 63);
    wp::uint64 x_borrow = 0, y_borrow = 0;
    for (int i = A; i < R && i < A + B; ++i) {
        const wp::uint64 s = y[i - A] & x_mask, old = p[i];
        p[i] = old - s - x_borrow;
        x_borrow = (old < s) | ((old == s) & x_borrow);
    }
    for (int i = B; i < R && i < A + B; ++i) {
        const wp::uint64 s = x[i - B] & y_mask, old = p[i];
        p[i] = old - s - y_borrow;
        y_borrow = (old < s) | ((old == s) & y_borrow);
    }
};
