// The body of make_narrow_polygon; largest_bits is how many bits a corner may have.

#if defined(__CUDA_ARCH__)
return -1;
#else
typedef double Doubles __attribute__((ext_vector_type(8)));
typedef decltype(Doubles() < Doubles()) Longs;
constexpr long long top = 1ll << 52, limit = 1ll << largest_bits;
for (int axis = 0; axis < 3; ++axis) {
    Doubles x;
    for (int point = 0; point < 8; ++point)
        x[point] = query.data[point][axis];
    const Longs word = __builtin_bit_cast(Longs, x);
    const Longs field = (word >> 52) & 2047, mantissa = word & (top - 1);
    // not by a comparison of the whole word, which a compiler makes one of numbers, that takes subnormals for zero
    const Longs is_zero = field == 0;
    if (__builtin_reduce_or(is_zero & (mantissa != 0)))
        return -1;  // subnormal
    if (__builtin_reduce_or(field == 2047))
        return 0;
    const Longs bits = mantissa | top, lowest_bit = bits & -bits;
    const Longs place = __builtin_bit_cast(Longs, __builtin_convertvector(lowest_bit, Doubles)) >> 52;
    const long long none = 4096, exponent = __builtin_reduce_min(is_zero ? Longs(none) : field + place - (1075 + 1023));
    if (exponent == none) {  // all are zero
        for (int corner = 0; corner < 8; ++corner)
            polygon.data[3 * corner + axis][0] = 0;
        continue;
    }
    if (exponent <= -1023 || exponent >= 1023)
        return -1;
    const double factor = __builtin_bit_cast(double, (1023 - exponent) << 52);
    const Doubles whole = x * factor;
    if (__builtin_reduce_or(__builtin_elementwise_abs(whole) >= 0x1p62))
        return -1;
    const Longs n = __builtin_convertvector(whole, Longs);
    const Longs first = edges ? __builtin_shufflevector(n, n, 2, 2, 3, 3, 6, 6, 7, 7)
                              : __builtin_shufflevector(n, n, 0, 0, 0, 0, 4, 4, 4, 4);
    const Longs second = edges ? __builtin_shufflevector(n, n, 0, 1, 1, 0, 4, 5, 5, 4)
                               : __builtin_shufflevector(n, n, 1, 2, 3, 3, 5, 6, 7, 7);
    const Longs corners = first - second;
    if (__builtin_reduce_or((corners >= limit) | (corners <= -limit)))
        return 0;
    for (int corner = 0; corner < 8; ++corner)
        polygon.data[3 * corner + axis][0] = (wp::uint64)corners[corner];
}
return 1;
#endif
