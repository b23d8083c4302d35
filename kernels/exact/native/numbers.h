// Expressions in double precision with bounds of their errors, of wide integers of type Integer.

// a value, and the same expression in absolute values
struct Number {
    double value, size;
    Number operator+(Number b) const { return {value + b.value, size + b.size}; }
    Number operator-(Number b) const { return {value - b.value, size + b.size}; }
    Number operator*(Number b) const { return {value * b.value, size * b.size}; }
    Number operator*(double b) const { return {value * b, size * b}; }
};
const auto sign = [](Number a) -> int {
    const double error = 0x1p-47 * a.size + 0x1p-800;
    return (a.value > error) - (a.value < -error);
};
// writes integers divided by a common power of two
const auto scale = [](const Integer* const* x, int count, Number* to) {
    constexpr int N = sizeof(Integer) / 8;
    int exponents[4], largest = 0;
    for (int j = 0; j < count; ++j) {
        const Integer& a = *x[j];
        const wp::uint64 mask = 0 - (a[N - 1] >> 63);
        int i = N - 1;
        while (i > 1 && a[i] == mask)
            --i;
        // below the two leading limbs, what is left out and the one that negation adds are less than a rounding
        unsigned __int128 bits = (unsigned __int128)(a[i] ^ mask) << 64 | (a[i - 1] ^ mask);
        if (i == 1)
            bits += mask & 1;
        const double size = (double)(wp::uint64)(bits >> 64) * 0x1p-64 + (double)(wp::uint64)bits * 0x1p-128;
        to[j].value = mask ? -size : size;
        exponents[j] = i;
        largest = i > largest ? i : largest;
    }
    for (int j = 0; j < count; ++j) {
        const int shift = 64 * (exponents[j] - largest);
        to[j].value *= __builtin_bit_cast(double, shift > -960 ? (wp::uint64)(1023 + shift) << 52 : 0);
        to[j].size = to[j].value < 0.0 ? -to[j].value : to[j].value;
    }
};
