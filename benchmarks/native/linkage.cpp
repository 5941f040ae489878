// What udkjax is measured against: the paper's five-bar parallelogram as a program of its own.
//
// Three parallel links on ground pivots carry a coupler: 12 Cartesian coordinates (x, y, angle of link 1, 2, 3 and the coupler),
// 12 constraint rows of which 11 are independent. The Udwadia-Kalaba equation
//
//     a = a_F + M^-1 Psi_q^T (Psi_q M^-1 Psi_q^T)^-1 (gamma - Psi_q a_F)
//
// by sparse elimination in a fixed order; where a pivot shows a singular configuration, the minimum-norm solution of all 12 rows.
// Integrated by DOP853 (Hairer, Norsett, Wanner I: coefficients, error estimate, step size and dense output are those of
// dop853.f); accepted steps and outputs are projected onto the constraint manifold.
//
// One source serves three kinds of scalars: double, eight doubles in a vector (lanes, a trajectory in each) and dual numbers.
//
//     linkage mode=single start=-45 tolerance=1e-8 t1=20 outputs=401 seconds=0.5 dump=FILE
//     linkage mode=batch lanes=8 starts=FILE tolerance=1e-8 t1=10 outputs=2 dump=FILE
//     linkage mode=gradient parameters=2 ...        d(angle of link 1 at the end) / d(the first of `PARAMETERS`)
//
// It prints JSON; `dump` gets the states (q, v) at the outputs, as float64. C++17 with the vectors of GCC and Clang.

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <map>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

// ---------------------------------------------------------------------------------------------------------------- scalars

typedef double Lanes __attribute__((vector_size(64)));
typedef long long Mask __attribute__((vector_size(64)));
constexpr int LANES = 8;

template <int P>
struct Dual {
    typedef double Tangent __attribute__((vector_size(P * sizeof(double))));
    double value;
    Tangent d;
};

template <class T>
struct Traits {  // a parameter of the mechanism, and what steers a step
    using Parameter = T;
    using Step = double;
    static T constant(double x) { return T{x}; }
};
template <>
struct Traits<Lanes> {
    using Parameter = double;
    using Step = Lanes;
    static Lanes constant(double x) { return Lanes{} + x; }
};
template <class T>
using Step = typename Traits<T>::Step;

#define INLINE inline __attribute__((always_inline))

template <int P> INLINE Dual<P> operator+(const Dual<P>& a, const Dual<P>& b) { return {a.value + b.value, a.d + b.d}; }
template <int P> INLINE Dual<P> operator-(const Dual<P>& a, const Dual<P>& b) { return {a.value - b.value, a.d - b.d}; }
template <int P> INLINE Dual<P> operator-(const Dual<P>& a) { return {-a.value, -a.d}; }
template <int P> INLINE Dual<P> operator+(const Dual<P>& a, double b) { return {a.value + b, a.d}; }
template <int P> INLINE Dual<P> operator-(const Dual<P>& a, double b) { return {a.value - b, a.d}; }
template <int P> INLINE Dual<P> operator*(double a, const Dual<P>& b) { return {a * b.value, a * b.d}; }
template <int P> INLINE Dual<P> operator*(const Dual<P>& a, double b) { return b * a; }
template <int P> INLINE Dual<P> operator*(const Dual<P>& a, const Dual<P>& b) {
    return {a.value * b.value, a.value * b.d + b.value * a.d};
}
template <int P> INLINE Dual<P> operator/(double a, const Dual<P>& b) {
    const double c = a / b.value;
    return {c, (-c / b.value) * b.d};
}
template <class T, class U> INLINE T& operator+=(T& a, const U& b) { return a = a + b; }
template <class T, class U> INLINE T& operator-=(T& a, const U& b) { return a = a - b; }

INLINE double value(double x) { return x; }
INLINE Lanes value(Lanes x) { return x; }
template <int P> INLINE double value(const Dual<P>& x) { return x.value; }

INLINE double least(double a, double b) { return std::min(a, b); }
INLINE double most(double a, double b) { return std::max(a, b); }
INLINE Lanes least(Lanes a, Lanes b) { return a < b ? a : b; }
INLINE Lanes most(Lanes a, Lanes b) { return a > b ? a : b; }
INLINE double magnitude(double x) { return std::fabs(x); }
INLINE Lanes magnitude(Lanes x) { return most(x, -x); }
INLINE double root(double x) { return std::sqrt(x); }
INLINE Lanes root(Lanes x) {
    for (int l = 0; l < LANES; l++) x[l] = std::sqrt(x[l]);
    return x;
}

INLINE void sine_cosine(double x, double& s, double& c) { s = std::sin(x), c = std::cos(x); }
template <int P> INLINE void sine_cosine(const Dual<P>& x, Dual<P>& s, Dual<P>& c) {
    sine_cosine(x.value, s.value, c.value);
    s.d = c.value * x.d, c.d = -s.value * x.d;
}
// In lanes, where the library would be called for one after another: Cody and Waite's reduction, the polynomials of fdlibm.
INLINE void sine_cosine(Lanes x, Lanes& sine, Lanes& cosine) {
    const Lanes shift = Lanes{} + 6755399441055744.0;  // 1.5 * 2^52: adding it rounds to an integer
    const Lanes turned = x * 0.63661977236758134308 + shift, n = turned - shift;
    const Mask k = (Mask)turned;
    const Lanes r = ((x - n * 1.57079632673412561417e00) - n * 6.07710050630396597660e-11) - n * 2.02226624879595063154e-21;
    const Lanes z = r * r;
    Lanes s = z * 1.58969099521155010221e-10 - 2.50507602534068634195e-08;
    Lanes c = z * -1.13596475577881948265e-11 + 2.08757232129817482790e-09;
    s = s * z + 2.75573137070700676789e-06, c = c * z - 2.75573143513906633035e-07;
    s = s * z - 1.98412698298579493134e-04, c = c * z + 2.48015872894767294178e-05;
    s = s * z + 8.33333333332248946124e-03, c = c * z - 1.38888888888741095749e-03;
    s = s * z - 1.66666666666666324348e-01, c = c * z + 4.16666666666666019037e-02;
    s = r + r * z * s, c = 1.0 - 0.5 * z + z * z * c;
    const Mask odd = (k & 1) != 0, minus_s = (k & 2) != 0, minus_c = ((k + 1) & 2) != 0;
    sine = odd ? c : s, cosine = odd ? s : c;
    sine = minus_s ? -sine : sine, cosine = minus_c ? -cosine : cosine;
}

// --------------------------------------------------------------------------------------------------------------- mechanism

constexpr int N = 24;             // state: 12 coordinates, 12 velocities
// Stages lie a little off the constraint manifold, and a small singular value amplifies that. Smaller thresholds cost steps: at
// tolerances of 1e-10 and less several times as many, with 1e-6 and 1e-4.
constexpr double SMALL_PIVOT = 1e-5;  // relative to the diagonal entry of its row
constexpr double RANK = 1e-3;         // singular values, relative to the largest
const double GROUND_PIN[3] = {0.0, 1.0, 2.0}, COUPLER_PIN[3] = {-1.0, 0.0, 1.0};
constexpr double HALF = 0.5;  // m, half of a link

template <class T>
struct Linkage {
    using P = typename Traits<T>::Parameter;
    P mass[3], coupler_mass, inertia[3], gravity;
    P light[3], nimble[3], coupler_light, coupler_nimble;  // reciprocals of masses and inertias

    explicit Linkage(const P (&number)[8]) {
        for (int i = 0; i < 3; i++) mass[i] = number[i], inertia[i] = number[4 + i];
        coupler_mass = number[3], gravity = number[7];
        for (int i = 0; i < 3; i++) light[i] = 1.0 / mass[i], nimble[i] = 1.0 / inertia[i];
        coupler_light = 1.0 / coupler_mass, coupler_nimble = Traits<P>::constant(1.0 / 0.2);
    }
};
const char* const PARAMETERS = "link1.mass link2.mass link3.mass coupler.mass link1.inertia link2.inertia link3.inertia gravity";
const double NUMBERS[8] = {1.0, 1.0, 1.0, 2.0, 0.1, 0.1, 0.1, 9.81};

// Arms, in ground axes: from a link's centre to its tip (to its foot: the negative), from the coupler's centre along its axis.
template <class T>
struct Arms {
    T x[4], y[4];

    INLINE explicit Arms(const T* q) {
        for (int b = 0; b < 4; b++) {
            sine_cosine(q[3 * b + 2], y[b], x[b]);
            if (b < 3) x[b] = HALF * x[b], y[b] = HALF * y[b];
        }
    }
    // Turned on by the small angle between two positions: to rounding up to 1e-3 rad, and without another sine.
    INLINE Arms turned(const T* from, const T* to) const {
        Arms next = *this;
        for (int b = 0; b < 4; b++) {
            const T e = to[3 * b + 2] - from[3 * b + 2], e2 = e * e;
            const T s = e + e * e2 * (e2 * (1.0 / 120.0) - 1.0 / 6.0), c = e2 * (e2 * (1.0 / 24.0) - 0.5);
            next.x[b] = x[b] + (x[b] * c - y[b] * s), next.y[b] = y[b] + (y[b] * c + x[b] * s);
        }
        return next;
    }
};

// Rows: a foot on the ground (Ax, Ay) and a tip on the coupler (Bx, By) for each link.
template <class T>
struct Rows {
    T a[3][2], b[3][2];
};

template <class T>
INLINE Rows<T> violation(const Arms<T>& arm, const T* q) {
    Rows<T> r;
    for (int i = 0; i < 3; i++) {
        r.a[i][0] = q[3 * i] - arm.x[i] - GROUND_PIN[i];
        r.a[i][1] = q[3 * i + 1] - arm.y[i];
        r.b[i][0] = q[3 * i] + arm.x[i] - q[9] - COUPLER_PIN[i] * arm.x[3];
        r.b[i][1] = q[3 * i + 1] + arm.y[i] - q[10] - COUPLER_PIN[i] * arm.y[3];
    }
    return r;
}

template <class T>
INLINE Rows<T> rate(const Arms<T>& arm, const T* v) {
    Rows<T> r;
    for (int i = 0; i < 3; i++) {
        const T turn_x = -arm.y[i] * v[3 * i + 2], turn_y = arm.x[i] * v[3 * i + 2];
        r.a[i][0] = v[3 * i] - turn_x;
        r.a[i][1] = v[3 * i + 1] - turn_y;
        r.b[i][0] = v[3 * i] + turn_x - v[9] + COUPLER_PIN[i] * (arm.y[3] * v[11]);
        r.b[i][1] = v[3 * i + 1] + turn_y - v[10] - COUPLER_PIN[i] * (arm.x[3] * v[11]);
    }
    return r;
}

// gamma - Psi_q a_F, gamma = -(Psi_q v)_q v. Gravity accelerates a link and the coupler alike: it is seen by the feet alone.
template <class T>
INLINE Rows<T> acceleration_rows(const Linkage<T>& linkage, const Arms<T>& arm, const T* v) {
    Rows<T> r;
    const T w3 = v[11] * v[11], pull_x = arm.x[3] * w3, pull_y = arm.y[3] * w3;
    for (int i = 0; i < 3; i++) {
        const T w = v[3 * i + 2] * v[3 * i + 2], x = arm.x[i] * w, y = arm.y[i] * w;
        r.a[i][0] = -x;
        r.a[i][1] = linkage.gravity - y;
        r.b[i][0] = x - COUPLER_PIN[i] * pull_x;
        r.b[i][1] = y - COUPLER_PIN[i] * pull_y;
    }
    return r;
}

// M^-1 Psi_q^T times multipliers.
template <class T>
INLINE void spread(const Linkage<T>& linkage, const Arms<T>& arm, const Rows<T>& m, T* a) {
    for (int i = 0; i < 3; i++) {
        a[3 * i] = linkage.light[i] * (m.a[i][0] + m.b[i][0]);
        a[3 * i + 1] = linkage.light[i] * (m.a[i][1] + m.b[i][1]);
        a[3 * i + 2] = linkage.nimble[i] * (arm.y[i] * (m.a[i][0] - m.b[i][0]) - arm.x[i] * (m.a[i][1] - m.b[i][1]));
    }
    a[9] = -(linkage.coupler_light * (m.b[0][0] + m.b[1][0] + m.b[2][0]));
    a[10] = -(linkage.coupler_light * (m.b[0][1] + m.b[1][1] + m.b[2][1]));
    a[11] = linkage.coupler_nimble * (arm.y[3] * (m.b[2][0] - m.b[0][0]) - arm.x[3] * (m.b[2][1] - m.b[0][1]));
}

long long minimum_norms = 0;  // how often a singular configuration was met

// The minimum-norm solution of all 12 rows, singular values below RANK left out. Hestenes's rotations J make the rows of
// J D, D = Psi_q M^-1/2, orthogonal; then D^+ r = sum of row (J r) / |row|^2.
class MinimumNorm {
    typedef double Half __attribute__((vector_size(32)));
    alignas(64) double rows[12][24] = {};  // J D, J
    double scale[12], weight[12];

    static INLINE double dot(const double* x, const double* y) {
        const Lanes low = *reinterpret_cast<const Lanes*>(x) * *reinterpret_cast<const Lanes*>(y);
        Half sum = *reinterpret_cast<const Half*>(x + 8) * *reinterpret_cast<const Half*>(y + 8);
        for (int k = 0; k < 4; k++) sum[k] += low[k] + low[k + 4];
        return (sum[0] + sum[2]) + (sum[1] + sum[3]);
    }

public:
    MinimumNorm(const Linkage<double>& linkage, const Arms<double>& arm) {
        minimum_norms++;
        for (int b = 0; b < 4; b++) {
            scale[3 * b] = scale[3 * b + 1] = std::sqrt(b < 3 ? linkage.light[b] : linkage.coupler_light);
            scale[3 * b + 2] = std::sqrt(b < 3 ? linkage.nimble[b] : linkage.coupler_nimble);
        }
        for (int i = 0; i < 3; i++) {
            double(*foot)[24] = rows + 4 * i, (*tip)[24] = rows + 4 * i + 2;
            for (int k = 0; k < 2; k++) foot[k][3 * i + k] = tip[k][3 * i + k] = 1.0, tip[k][9 + k] = -1.0;
            foot[0][3 * i + 2] = arm.y[i], foot[1][3 * i + 2] = -arm.x[i];
            tip[0][3 * i + 2] = -arm.y[i], tip[1][3 * i + 2] = arm.x[i];
            tip[0][11] = COUPLER_PIN[i] * arm.y[3], tip[1][11] = -COUPLER_PIN[i] * arm.x[3];
        }
        for (int i = 0; i < 12; i++) {
            for (int k = 0; k < 12; k++) rows[i][k] *= scale[k];
            rows[i][12 + i] = 1.0;
        }
        constexpr double ORTHOGONAL = 1e-15;  // cosine of the angle between two rows
        constexpr double NEARLY = 1e-8;       // a round that meets no larger one was the last: it squares them
        constexpr double ROUNDING = 1e-16;    // of the squares, kept up to date below, relative to the largest
        double norm[12], largest = 0.0;
        for (bool more = true; more;) {
            more = false;
            for (int i = 0; i < 12; i++) largest = std::max(largest, norm[i] = dot(rows[i], rows[i]));
            const double least = ROUNDING * largest;
            for (int round = 0; round < 11; round++)  // as in a tournament: six pairs that do not wait for one another
                for (int m = 0; m < 6; m++) {
                    const int i = (round + m) % 11, j = m == 0 ? 11 : (round + 11 - m) % 11;
                    const double p = dot(rows[i], rows[j]);
                    const double both = std::max(norm[i], least) * std::max(norm[j], least);
                    if (p * p <= ORTHOGONAL * ORTHOGONAL * both) continue;
                    more |= p * p > NEARLY * NEARLY * both;
                    const double half = 0.5 * (norm[j] - norm[i]);
                    const double t = p / (half + std::copysign(std::sqrt(half * half + p * p), half));
                    const double cosine = 1.0 / std::sqrt(1.0 + t * t), sine = cosine * t;
                    for (int k = 0; k < 24; k += 8) {
                        Lanes &x = *reinterpret_cast<Lanes*>(rows[i] + k), &y = *reinterpret_cast<Lanes*>(rows[j] + k);
                        const Lanes old = x;
                        x = cosine * x - sine * y, y = sine * old + cosine * y;
                    }
                    norm[i] -= t * p, norm[j] += t * p;
                }
        }
        for (int i = 0; i < 12; i++) {
            const double square = dot(rows[i], rows[i]);
            weight[i] = square > RANK * RANK * largest ? 1.0 / square : 0.0;
        }
    }

    void solve(const Rows<double>& r, double* a) const {
        double b[12], x[12] = {};
        for (int i = 0; i < 3; i++)
            for (int k = 0; k < 2; k++) b[4 * i + k] = r.a[i][k], b[4 * i + 2 + k] = r.b[i][k];
        for (int i = 0; i < 12; i++) {
            double turned = 0.0;
            for (int k = 0; k < 12; k++) turned += rows[i][12 + k] * b[k];
            for (int k = 0; k < 12; k++) x[k] += rows[i][k] * (turned * weight[i]);
        }
        for (int k = 0; k < 12; k++) a[k] = scale[k] * x[k];
    }
};

// L diag(p) L^T = D D^T of 11 rows (By of link 2 left out). Order: the feet, which fill nothing in but the block of their tip;
// then the tips of links 1 and 3 and Bx of link 2, a dense block of five.
template <class T>
struct Factors {
    T foot_lower[3], tip_lower[3][2][2], foot_inverse[3][2];
    T lower[5][5], inverse[5];
    Step<T> margin;  // the least of pivot - SMALL_PIVOT * diagonal: negative where the configuration is singular
    Arms<T> arm;

    INLINE Factors(const Linkage<T>& linkage, const Arms<T>& at) : arm(at) {
        margin = value(Traits<T>::constant(1.0));
        T G[5][5];
        for (int i = 0; i < 3; i++) {
            const T light = light_of(linkage, i), x = arm.x[i], y = arm.y[i];
            const T xx = linkage.nimble[i] * x * x, xy = linkage.nimble[i] * x * y, yy = linkage.nimble[i] * y * y;
            // Of the feet and, the arms being opposite, of the tips; feet against tips turn the other way.
            const T own_x = light + yy, own_y = light + xx, across_x = light - yy, across_y = light - xx;
            const T l = -(xy * (foot_inverse[i][0] = 1.0 / own_x));
            const T pivot = own_y + l * xy;
            watch(pivot, own_y);
            foot_inverse[i][1] = 1.0 / pivot, foot_lower[i] = l;
            // Tip rows against feet: (across_x, xy), (xy, across_y); reduced by the first foot.
            const T second[2] = {xy - l * across_x, across_y - l * xy}, first[2] = {across_x, xy};
            for (int k = 0; k < 2; k++) {
                tip_lower[i][k][0] = first[k] * foot_inverse[i][0];
                tip_lower[i][k][1] = second[k] * foot_inverse[i][1];
            }
            const int at = i == 0 ? 0 : i == 2 ? 2 : 4;
            const double pin = COUPLER_PIN[i] * COUPLER_PIN[i];
            const T turn_x = linkage.coupler_nimble * arm.x[3], turn_y = linkage.coupler_nimble * arm.y[3];
            const T full_x = own_x + linkage.coupler_light + pin * (turn_y * arm.y[3]);
            diagonal[at] = full_x;
            G[at][at] = full_x - tip_lower[i][0][0] * first[0] - tip_lower[i][0][1] * second[0];
            if (i == 1) continue;
            const T full_y = own_y + linkage.coupler_light + pin * (turn_x * arm.x[3]);
            diagonal[at + 1] = full_y;
            G[at + 1][at + 1] = full_y - tip_lower[i][1][0] * first[1] - tip_lower[i][1][1] * second[1];
            G[at + 1][at] = -xy - pin * (turn_x * arm.y[3]) - tip_lower[i][1][0] * first[0] - tip_lower[i][1][1] * second[0];
        }
        // Through the coupler: the pins of links 1 and 3 lie opposite each other, that of link 2 at its centre.
        const T turn_x = linkage.coupler_nimble * arm.x[3], turn_y = linkage.coupler_nimble * arm.y[3];
        G[2][0] = linkage.coupler_light - turn_y * arm.y[3];
        G[3][1] = linkage.coupler_light - turn_x * arm.x[3];
        G[3][0] = G[2][1] = turn_x * arm.y[3];
        G[4][0] = G[4][2] = linkage.coupler_light * Traits<T>::constant(1.0);
        G[4][1] = G[4][3] = Traits<T>::constant(0.0);
#pragma GCC unroll 5
        for (int j = 0; j < 5; j++) {
            watch(G[j][j], diagonal[j]);
            inverse[j] = 1.0 / G[j][j];
#pragma GCC unroll 5
            for (int i = j + 1; i < 5; i++) {
                lower[i][j] = G[i][j] * inverse[j];
#pragma GCC unroll 5
                for (int k = j + 1; k <= i; k++) G[i][k] -= lower[i][j] * G[k][j];
            }
        }
    }

    // M^-1 Psi_q^T (Psi_q M^-1 Psi_q^T)^-1 r.
    INLINE void solve(const Linkage<T>& linkage, const Rows<T>& r, T* a) const {
        Rows<T> m;
        T y[5] = {r.b[0][0], r.b[0][1], r.b[2][0], r.b[2][1], r.b[1][0]};
        for (int i = 0; i < 3; i++) {
            const int at = i == 0 ? 0 : i == 2 ? 2 : 4;
            m.a[i][0] = r.a[i][0];
            m.a[i][1] = r.a[i][1] - foot_lower[i] * m.a[i][0];
            y[at] -= tip_lower[i][0][0] * m.a[i][0] + tip_lower[i][0][1] * m.a[i][1];
            if (i != 1) y[at + 1] -= tip_lower[i][1][0] * m.a[i][0] + tip_lower[i][1][1] * m.a[i][1];
        }
#pragma GCC unroll 5
        for (int j = 0; j < 5; j++)
#pragma GCC unroll 5
            for (int i = j + 1; i < 5; i++) y[i] -= lower[i][j] * y[j];
#pragma GCC unroll 5
        for (int j = 4; j >= 0; j--) {
            y[j] = y[j] * inverse[j];
#pragma GCC unroll 5
            for (int i = j + 1; i < 5; i++) y[j] -= lower[i][j] * y[i];
        }
        for (int i = 0; i < 3; i++) {
            const int at = i == 0 ? 0 : i == 2 ? 2 : 4;
            m.b[i][0] = y[at];
            m.b[i][1] = i == 1 ? Traits<T>::constant(0.0) : y[at + 1];
            const T first = m.a[i][0] * foot_inverse[i][0], second = m.a[i][1] * foot_inverse[i][1];
            if (i == 1) {
                m.a[i][1] = second - tip_lower[i][0][1] * y[at];
                m.a[i][0] = first - foot_lower[i] * m.a[i][1] - tip_lower[i][0][0] * y[at];
            } else {
                m.a[i][1] = second - tip_lower[i][0][1] * y[at] - tip_lower[i][1][1] * y[at + 1];
                m.a[i][0] = first - foot_lower[i] * m.a[i][1] - tip_lower[i][0][0] * y[at] - tip_lower[i][1][0] * y[at + 1];
            }
        }
        spread(linkage, arm, m, a);
    }

private:
    T diagonal[5];

    static INLINE T light_of(const Linkage<T>& linkage, int i) { return Traits<T>::constant(1.0) * linkage.light[i]; }

    INLINE void watch(const T& pivot, const T& whole) { margin = least(margin, value(pivot) - SMALL_PIVOT * value(whole)); }
};

INLINE bool singular(double margin) { return __builtin_expect(margin < 0.0, 0); }
INLINE bool any(Mask m) {
    long long bits = 0;
    for (int l = 0; l < LANES; l++) bits |= m[l];
    return bits != 0;
}
INLINE bool singular(Lanes margin) { return __builtin_expect(any(margin < 0.0), 0); }

// Where lanes are singular, the same for each of these alone.
template <class Alone>
void each_alone(Lanes margin, const Lanes* y, Lanes* to, Alone alone) {
    const Linkage<double> linkage(NUMBERS);
    for (int l = 0; l < LANES; l++)
        if (margin[l] < 0.0) {
            double one[N], out[N];
            for (int i = 0; i < N; i++) one[i] = y[i][l];
            alone(linkage, one, out);
            for (int i = 0; i < N; i++) to[i][l] = out[i];
        }
}
[[noreturn]] void refuse() {
    std::fprintf(stderr, "no derivatives at a singular configuration\n");
    std::exit(1);
}

template <class T>
__attribute__((noinline)) void derivative(const Linkage<T>& linkage, const T* y, T* dy) {
    const Arms<T> arm(y);
    const Factors<T> factors(linkage, arm);
    const Rows<T> rows = acceleration_rows(linkage, arm, y + 12);
    for (int i = 0; i < 12; i++) dy[i] = y[12 + i];
    factors.solve(linkage, rows, dy + 12);
    if (singular(factors.margin)) {
        if constexpr (std::is_same_v<T, double>)
            MinimumNorm(linkage, arm).solve(rows, dy + 12);
        else if constexpr (std::is_same_v<T, Lanes>)
            each_alone(factors.margin, y, dy, [](const Linkage<double>& linkage, const double* y, double* dy) {
                derivative(linkage, y, dy);
                for (int b = 0; b < 4; b++) dy[12 + 3 * b + 1] += linkage.gravity;
            });
        else
            refuse();
    }
    for (int b = 0; b < 4; b++) dy[12 + 3 * b + 1] -= linkage.gravity;
}

// Two Newton steps in position and one in velocity, with the factors of the first position.
template <class T, class Solver>
INLINE void newton(const Linkage<T>& linkage, const Arms<T>& first, Solver solve, const T* y, T* to) {
    Arms<T> arm = first;
    T step[12];
    std::copy(y, y + N, to);
    for (int n = 0; n < 2; n++) {
        solve(violation(arm, to), step);
        T moved[12];
        for (int i = 0; i < 12; i++) moved[i] = to[i] - step[i];
        arm = arm.turned(to, moved);
        std::copy(moved, moved + 12, to);
    }
    solve(rate(arm, to + 12), step);
    for (int i = 0; i < 12; i++) to[12 + i] -= step[i];
}

template <class T>
__attribute__((noinline)) void project(const Linkage<T>& linkage, T* y) {
    const Arms<T> arm(y);
    const Factors<T> factors(linkage, arm);
    T to[N];
    newton(linkage, arm, [&](const Rows<T>& r, T* step) { factors.solve(linkage, r, step); }, y, to);
    if (singular(factors.margin)) {
        if constexpr (std::is_same_v<T, double>) {
            const MinimumNorm all(linkage, arm);
            newton(linkage, arm, [&](const Rows<T>& r, T* step) { all.solve(r, step); }, y, to);
        } else if constexpr (std::is_same_v<T, Lanes>)
            each_alone(factors.margin, y, to, [](const Linkage<double>& linkage, const double* y, double* to) {
                std::copy(y, y + N, to);
                project(linkage, to);
            });
        else
            refuse();
    }
    std::copy(to, to + N, y);
}

// -------------------------------------------------------------------------------------------------------------- integrator

// Rows: stages 1 to 12, the end of the step, three more stages, and the four upper coefficients of the dense output.
constexpr double A[20][16] = {
    {},
    {5.26001519587677318785587544488e-2},
    {1.97250569845378994544595329183e-2, 5.91751709536136983633785987549e-2},
    {2.95875854768068491816892993775e-2, 0, 8.87627564304205475450678981324e-2},
    {2.41365134159266685502369798665e-1, 0, -8.84549479328286085344864962717e-1, 9.24834003261792003115737966543e-1},
    {3.7037037037037037037037037037e-2, 0, 0, 1.70828608729473871279604482173e-1, 1.25467687566822425016691814123e-1},
    {3.7109375e-2, 0, 0, 1.70252211019544039314978060272e-1, 6.02165389804559606850219397283e-2, -1.7578125e-2},
    {3.70920001185047927108779319836e-2, 0, 0, 1.70383925712239993810214054705e-1, 1.07262030446373284651809199168e-1,
     -1.53194377486244017527936158236e-2, 8.27378916381402288758473766002e-3},
    {6.24110958716075717114429577812e-1, 0, 0, -3.36089262944694129406857109825, -8.68219346841726006818189891453e-1,
     2.75920996994467083049415600797e1, 2.01540675504778934086186788979e1, -4.34898841810699588477366255144e1},
    {4.77662536438264365890433908527e-1, 0, 0, -2.48811461997166764192642586468, -5.90290826836842996371446475743e-1,
     2.12300514481811942347288949897e1, 1.52792336328824235832596922938e1, -3.32882109689848629194453265587e1,
     -2.03312017085086261358222928593e-2},
    {-9.3714243008598732571704021658e-1, 0, 0, 5.18637242884406370830023853209, 1.09143734899672957818500254654,
     -8.14978701074692612513997267357, -1.85200656599969598641566180701e1, 2.27394870993505042818970056734e1,
     2.49360555267965238987089396762, -3.0467644718982195003823669022},
    {2.27331014751653820792359768449, 0, 0, -1.05344954667372501984066689879e1, -2.00087205822486249909675718444,
     -1.79589318631187989172765950534e1, 2.79488845294199600508499808837e1, -2.85899827713502369474065508674,
     -8.87285693353062954433549289258, 1.23605671757943030647266201528e1, 6.43392746015763530355970484046e-1},
    {5.42937341165687622380535766363e-2, 0, 0, 0, 0, 4.45031289275240888144113950566, 1.89151789931450038304281599044,
     -5.8012039600105847814672114227, 3.1116436695781989440891606237e-1, -1.52160949662516078556178806805e-1,
     2.01365400804030348374776537501e-1, 4.47106157277725905176885569043e-2},
    {5.61675022830479523392909219681e-2, 0, 0, 0, 0, 0, 2.53500210216624811088794765333e-1,
     -2.46239037470802489917441475441e-1, -1.24191423263816360469010140626e-1, 1.5329179827876569731206322685e-1,
     8.20105229563468988491666602057e-3, 7.56789766054569976138603589584e-3, -8.298e-3},
    {3.18346481635021405060768473261e-2, 0, 0, 0, 0, 2.83009096723667755288322961402e-2,
     5.35419883074385676223797384372e-2, -5.49237485713909884646569340306e-2, 0, 0, -1.08347328697249322858509316994e-4,
     3.82571090835658412954920192323e-4, -3.40465008687404560802977114492e-4, 1.41312443674632500278074618366e-1},
    {-4.28896301583791923408573538692e-1, 0, 0, 0, 0, -4.69762141536116384314449447206, 7.68342119606259904184240953878,
     4.06898981839711007970213554331, 3.56727187455281109270669543021e-1, 0, 0, 0, -1.39902416515901462129418009734e-3,
     2.9475147891527723389556272149, -9.15095847217987001081870187138},
    {-0.84289382761090128651353491142e+1, 0, 0, 0, 0, 0.56671495351937776962531783590,
     -0.30689499459498916912797304727e+1, 0.23846676565120698287728149680e+1, 0.21170345824450282767155149946e+1,
     -0.87139158377797299206789907490, 0.22404374302607882758541771650e+1, 0.63157877876946881815570249290,
     -0.88990336451333310820698117400e-1, 0.18148505520854727256656404962e+2, -0.91946323924783554000451984436e+1,
     -0.44360363875948939664310572000e+1},
    {0.10427508642579134603413151009e+2, 0, 0, 0, 0, 0.24228349177525818288430175319e+3,
     0.16520045171727028198505394887e+3, -0.37454675472269020279518312152e+3, -0.22113666853125306036270938578e+2,
     0.77334326684722638389603898808e+1, -0.30674084731089398182061213626e+2, -0.93321305264302278729567221706e+1,
     0.15697238121770843886131091075e+2, -0.31139403219565177677282850411e+2, -0.93529243588444783865713862664e+1,
     0.35816841486394083752465898540e+2},
    {0.19985053242002433820987653617e+2, 0, 0, 0, 0, -0.38703730874935176555105901742e+3,
     -0.18917813819516756882830838328e+3, 0.52780815920542364900561016686e+3, -0.11573902539959630126141871134e+2,
     0.68812326946963000169666922661e+1, -0.10006050966910838403183860980e+1, 0.77771377980534432092869265740,
     -0.27782057523535084065932004339e+1, -0.60196695231264120758267380846e+2, 0.84320405506677161018159903784e+2,
     0.11992291136182789328035130030e+2},
    {-0.25693933462703749003312586129e+2, 0, 0, 0, 0, -0.15418974869023643374053993627e+3,
     -0.23152937917604549567536039109e+3, 0.35763911791061412378285349910e+3, 0.93405324183624310003907691704e+2,
     -0.37458323136451633156875139351e+2, 0.10409964950896230045147246184e+3, 0.29840293426660503123344363579e+2,
     -0.43533456590011143754432175058e+2, 0.96324553959188282948394950600e+2, -0.39177261675615439165231486172e+2,
     -0.14972683625798562581422125276e+3},
};
constexpr int UPPER = 16;
constexpr double E5[12] = {0.1312004499419488073250102996e-1, 0, 0, 0, 0, -0.1225156446376204440720569753e+1,
     -0.4957589496572501915214079952,
     0.1664377182454986536961530415e+1, -0.3503288487499736816886487290, 0.3341791187130174790297318841,
     0.8192320648511571246570742613e-1, -0.2235530786388629525884427845e-1};
constexpr double E3[3] = {0.244094488188976377952755905512, 0.733846688281611857341361741547, 0.0220588235294117647058823529412};
constexpr int NEW = 12;  // the place of the derivative at the end of the step, among the stages
constexpr double SAFETY = 0.9, SHRINK = 0.333, GROW = 6.0;

// The stages weighted by a row of A, its zeros left out when compiled.
template <int row, class T, size_t... J>
INLINE T weighted(const T (*k)[N], int i, std::index_sequence<J...>) {
    T sum = Traits<T>::constant(0.0);
    ((void)[&] { if constexpr (A[row][J] != 0.0) sum += A[row][J] * k[J][i]; }(), ...);
    return sum;
}
template <int stage, class T>
INLINE void combine(const T* y, const Step<T>& h, const T (*k)[N], T* at) {
    for (int i = 0; i < N; i++) at[i] = y[i] + h * weighted<stage>(k, i, std::make_index_sequence<stage>());
}
template <class T, size_t... S>
INLINE void stages(const Linkage<T>& linkage, const T* y, const Step<T>& h, T (*k)[N], std::index_sequence<S...>) {
    T at[N];
    ((combine<int(S)>(y, h, k, at), derivative(linkage, at, k[S])), ...);
}

// Stages 2 to 12 and the end of a step, from k[0]; returns the error over the tolerance.
template <class T>
Step<T> attempt(const Linkage<T>& linkage, const T* y, const Step<T>& h, double tolerance, T (*k)[N], T* end) {
    stages(linkage, y, h, k, std::index_sequence<1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11>());
    Step<T> fifth{}, third{};
    for (int i = 0; i < N; i++) {
        const T slope = weighted<NEW>(k, i, std::make_index_sequence<12>());
        end[i] = y[i] + h * slope;
        const Step<T> scale = 1.0 / (tolerance + tolerance * most(magnitude(value(y[i])), magnitude(value(end[i]))));
        const Step<T> e3 = (value(slope) - E3[0] * value(k[0][i]) - E3[1] * value(k[8][i]) - E3[2] * value(k[11][i])) * scale;
        Step<T> e5 = E5[0] * value(k[0][i]);
        for (int j = 5; j < 12; j++) e5 += E5[j] * value(k[j][i]);
        e5 = e5 * scale;
        fifth += e5 * e5, third += e3 * e3;
    }
    const Step<T> both = (fifth + 0.01 * third) * double(N) + 1e-300;
    return h * fifth * (1.0 / root(both));
}

// By which the step is divided; 1/8 power, beta = 0.
template <class S>
INLINE S divisor(const S& error) {
    return most(S{} + 1.0 / GROW, least(S{} + 1.0 / SHRINK, root(root(root(error))) * (1.0 / SAFETY)));
}

template <class T>
struct Dense {
    T c[8][N];

    // From a step's ends and stages, with three more of these.
    INLINE Dense(const Linkage<T>& linkage, const T* y, const T* end, const Step<T>& h, T (*k)[N]) {
        stages(linkage, y, h, k, std::index_sequence<13, 14, 15>());
        for (int i = 0; i < N; i++) {
            const T whole = end[i] - y[i], bend = h * k[0][i] - whole;
            c[0][i] = y[i], c[1][i] = whole, c[2][i] = bend, c[3][i] = whole - h * k[NEW][i] - bend;
            c[4][i] = h * weighted<UPPER>(k, i, std::make_index_sequence<16>());
            c[5][i] = h * weighted<UPPER + 1>(k, i, std::make_index_sequence<16>());
            c[6][i] = h * weighted<UPPER + 2>(k, i, std::make_index_sequence<16>());
            c[7][i] = h * weighted<UPPER + 3>(k, i, std::make_index_sequence<16>());
        }
    }
    INLINE T upper(const Step<T>& s, const Step<T>& r, int i) const {
        return c[4][i] + s * (c[5][i] + r * (c[6][i] + s * c[7][i]));
    }
    INLINE void at(const Step<T>& s, T* y) const {
        const Step<T> r = 1.0 - s;
        for (int i = 0; i < N; i++)
            y[i] = c[0][i] + s * (c[1][i] + r * (c[2][i] + s * (c[3][i] + r * upper(s, r, i))));
    }
};

struct Settings {
    double tolerance, t1;
    int outputs;  // evenly spaced, with start and end
    double time(int j) const { return j == outputs - 1 ? t1 : t1 * j / (outputs - 1); }
};
struct Counts {
    long long accepted = 0, rejected = 0, right_hand_sides = 0;
};

// Hairer's HINIT.
template <class T>
double first_step(const Linkage<T>& linkage, const T* y, const T* slope, const Settings& set) {
    double size = 0.0, steep = 0.0, bent = 0.0, scale[N];
    for (int i = 0; i < N; i++) {
        scale[i] = 1.0 / (set.tolerance + set.tolerance * std::fabs(value(y[i])));
        size += std::pow(value(y[i]) * scale[i], 2), steep += std::pow(value(slope[i]) * scale[i], 2);
    }
    double h = std::min(size <= 1e-10 || steep <= 1e-10 ? 1e-6 : 0.01 * std::sqrt(size / steep), set.t1);
    T at[N], next[N];
    for (int i = 0; i < N; i++) at[i] = y[i] + h * slope[i];
    derivative(linkage, at, next);
    for (int i = 0; i < N; i++) bent += std::pow(value(next[i] - slope[i]) * scale[i], 2);
    const double curve = std::max(std::sqrt(bent) / h, std::sqrt(steep));
    const double eighth = curve <= 1e-15 ? std::max(1e-6, h * 1e-3) : std::pow(0.01 / curve, 1.0 / 8.0);
    return std::min({100.0 * h, eighth, set.t1});
}

// One trajectory; its states at the outputs.
template <class T>
Counts integrate(const Linkage<T>& linkage, const T* start, const Settings& set, T (*out)[N]) {
    T k[16][N], y[N], end[N];
    Counts counts;
    std::copy(start, start + N, y);
    std::copy(start, start + N, out[0]);
    derivative(linkage, y, k[0]);
    double t = 0.0, h = first_step(linkage, y, k[0], set);
    counts.right_hand_sides = 2;
    bool again = false;
    for (int j = 1; j < set.outputs;) {
        const bool last = t + 1.01 * h >= set.t1;
        if (last) h = set.t1 - t;
        if (!(h > 1e-14 * set.t1)) break;
        const double error = attempt(linkage, y, h, set.tolerance, k, end);
        counts.right_hand_sides += 11;
        if (!(error <= 1.0)) {
            counts.rejected++, again = true;
            h *= 1.0 / std::min(1.0 / SHRINK, std::isfinite(error) ? std::pow(error, 0.125) / SAFETY : 10.0);
            continue;
        }
        counts.accepted++;
        project(linkage, end);
        derivative(linkage, end, k[NEW]);
        counts.right_hand_sides++;
        const double t_end = last ? set.t1 : t + h;
        if (set.time(j) < t_end) {
            const Dense<T> dense(linkage, y, end, h, k);
            counts.right_hand_sides += 3;
            for (; set.time(j) < t_end; j++) {
                dense.at((set.time(j) - t) / h, out[j]);
                project(linkage, out[j]);
            }
        }
        if (last) std::copy(end, end + N, out[j++]);
        std::copy(end, end + N, y);
        std::copy(k[NEW], k[NEW] + N, k[0]);
        t = t_end;
        const double next = h / divisor(error);
        h = again ? std::min(next, h) : next;
        again = false;
    }
    return counts;
}

template <class T>
void place(double angle, T* y) {
    std::fill(y, y + N, Traits<T>::constant(0.0));
    const double c = std::cos(angle), s = std::sin(angle);
    for (int i = 0; i < 3; i++) {
        y[3 * i] = Traits<T>::constant(GROUND_PIN[i] + HALF * c), y[3 * i + 1] = Traits<T>::constant(HALF * s);
        y[3 * i + 2] = Traits<T>::constant(angle);
    }
    y[9] = Traits<T>::constant(1.0 + 2.0 * HALF * c), y[10] = Traits<T>::constant(2.0 * HALF * s);
}

// Many trajectories, eight at a time: each lane has its own time and step, and takes up the next start when it is done.
Counts integrate_lanes(const std::vector<double>& starts, const Settings& set, std::vector<double>& out) {
    const Linkage<Lanes> linkage(NUMBERS);
    const Linkage<double> one(NUMBERS);
    Counts counts;
    alignas(64) Lanes k[16][N], y[N], end[N];
    Lanes t{}, h{};
    Mask running{}, again{};
    int member[LANES], j[LANES];
    size_t waiting = 0;
    const auto row = [&](int m, int output) { return &out[(size_t(m) * set.outputs + output) * N]; };

    const auto load = [&](int l) {  // the next start into a lane
        if (waiting == starts.size()) {
            running[l] = 0, h[l] = 0.0;
            return;
        }
        double at[N], slope[N];
        member[l] = int(waiting++), j[l] = 1;
        place(starts[member[l]], at);
        derivative(one, at, slope);
        counts.right_hand_sides += 2;
        std::copy(at, at + N, row(member[l], 0));
        for (int i = 0; i < N; i++) y[i][l] = at[i], k[0][i][l] = slope[i];
        t[l] = 0.0, h[l] = first_step(one, at, slope, set), running[l] = -1, again[l] = 0;
    };
    double hanging[N];  // what a lane without a start computes, for nothing
    place(-M_PI / 2, hanging);
    for (int i = 0; i < N; i++) y[i] = Lanes{} + hanging[i], k[0][i] = Lanes{};
    for (int l = 0; l < LANES; l++) load(l);

    while (any(running)) {
        const Mask last = t + 1.01 * h >= set.t1;
        h = last ? set.t1 - t : h;
        h = running ? h : Lanes{};
        const Lanes error = attempt(linkage, y, h, set.tolerance, k, end);
        counts.right_hand_sides += 12 * LANES;
        const Mask good = (error <= 1.0) & running, bad = ~good & running;
        for (int l = 0; l < LANES; l++) counts.accepted -= good[l], counts.rejected -= bad[l];
        project(linkage, end);
        derivative(linkage, end, k[NEW]);
        const Lanes t_end = last ? Lanes{} + set.t1 : t + h;

        Mask due{};
        for (int l = 0; l < LANES; l++) due[l] = good[l] && set.time(j[l]) < t_end[l] ? -1 : 0;
        if (any(due)) {
            const Dense<Lanes> dense(linkage, y, end, h, k);
            counts.right_hand_sides += 3 * LANES;
            while (any(due)) {
                Lanes share{}, state[N];
                for (int l = 0; l < LANES; l++) share[l] = due[l] ? (set.time(j[l]) - t[l]) / h[l] : 0.0;
                dense.at(share, state);
                project(linkage, state);
                for (int l = 0; l < LANES; l++)
                    if (due[l]) {
                        double* to = row(member[l], j[l]++);
                        for (int i = 0; i < N; i++) to[i] = state[i][l];
                        due[l] = set.time(j[l]) < t_end[l] ? -1 : 0;
                    }
            }
        }
        for (int i = 0; i < N; i++) y[i] = good ? end[i] : y[i], k[0][i] = good ? k[NEW][i] : k[0][i];
        t = good ? t_end : t;
        const Lanes next = h / divisor(error == error ? error : Lanes{} + 1e3), shrunk = least(next, h);
        h = good & ~again ? next : shrunk;
        again = bad;
        for (int l = 0; l < LANES; l++)
            if (good[l] && last[l]) {
                double* to = row(member[l], set.outputs - 1);
                for (int i = 0; i < N; i++) to[i] = y[i][l];
                load(l);
            } else if (running[l] && !(h[l] > 1e-14 * set.t1)) {
                load(l);  // what it has not reached stays what it was
            }
    }
    return counts;
}

// ----------------------------------------------------------------------------------------------------------------- program

double cpu_seconds() {
    timespec now;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
    return double(now.tv_sec) + 1e-9 * double(now.tv_nsec);
}

// The CPU time of each run, repeated for so many seconds.
template <class Run>
std::vector<double> repeated(double seconds, Run run) {
    run();
    std::vector<double> times;
    for (double total = 0.0; total < seconds || times.size() < 3;) {
        const double start = cpu_seconds();
        run();
        times.push_back(cpu_seconds() - start);
        total += times.back();
    }
    std::sort(times.begin(), times.end());
    return times;
}

std::vector<double> read_numbers(const std::string& path) {
    std::vector<double> numbers;
    if (FILE* file = std::fopen(path.c_str(), "rb")) {
        for (double x; std::fread(&x, sizeof x, 1, file) == 1;) numbers.push_back(x);
        std::fclose(file);
    }
    return numbers;
}

void write_numbers(const std::string& path, const double* numbers, size_t count) {
    FILE* file = std::fopen(path.c_str(), "wb");
    if (!file || std::fwrite(numbers, sizeof(double), count, file) != count) {
        std::perror(path.c_str());
        std::exit(1);
    }
    std::fclose(file);
}

void print(const std::vector<double>& times, const Counts& counts, long long singular, const std::string& more) {
    const auto at = [&](double part) { return times[size_t(part * double(times.size() - 1))]; };
    std::printf("{\"seconds\": %.9g, \"quartiles\": [%.9g, %.9g], ", at(0.5), at(0.25), at(0.75));
    std::printf("\"repetitions\": %zu, \"accepted\": %lld, ", times.size(), counts.accepted);
    std::printf("\"rejected\": %lld, \"right_hand_sides\": %lld, ", counts.rejected, counts.right_hand_sides);
    std::printf("\"minimum_norms\": %lld%s}\n", singular, more.c_str());
}

template <int P>
void gradient(double angle, const Settings& set, double seconds) {
    Dual<P> numbers[8], start[N];
    for (int i = 0; i < 8; i++) {
        numbers[i] = Dual<P>{NUMBERS[i], {}};
        if (i < P) numbers[i].d[i] = 1.0;
    }
    const Linkage<Dual<P>> linkage(numbers);
    place(angle, start);
    Counts counts;
    std::vector<Dual<P>> out(size_t(set.outputs) * N);
    const auto times = repeated(
        seconds, [&] { counts = integrate(linkage, start, set, reinterpret_cast<Dual<P>(*)[N]>(out.data())); });
    std::string more = ", \"parameters\": [";
    const std::string names = PARAMETERS;
    for (size_t p = 0, from = 0; p < P; p++) {
        const size_t to = std::min(names.find(' ', from), names.size());
        more += (p ? ", \"" : "\"") + names.substr(from, to - from) + "\"";
        from = to + 1;
    }
    char number[64];
    const Dual<P>& last = out[size_t(set.outputs - 1) * N + 2];
    std::snprintf(number, sizeof number, "], \"angle\": %.17g, \"gradient\": [", last.value);
    more += number;
    for (int p = 0; p < P; p++) {
        std::snprintf(number, sizeof number, p ? ", %.17g" : "%.17g", last.d[p]);
        more += number;
    }
    print(times, counts, 0, more + "]");
}

int main(int count, char** words) {
    std::map<std::string, std::string> given{{"mode", "single"}, {"start", "-45"}, {"tolerance", "1e-8"}, {"t1", "20"},
                                             {"outputs", "401"}, {"seconds", "0.5"}, {"lanes", "8"}, {"parameters", "1"},
                                             {"starts", ""}, {"dump", ""}};
    for (int i = 1; i < count; i++) {
        const char* equals = std::strchr(words[i], '=');
        const std::string name(words[i], equals ? size_t(equals - words[i]) : std::strlen(words[i]));
        if (!equals || !given.count(name)) {
            std::fprintf(stderr, "unknown setting %s\n", words[i]);
            return 2;
        }
        given[name] = equals + 1;
    }
    const auto number = [&](const char* name) { return std::atof(given[name].c_str()); };
    const Settings set{number("tolerance"), number("t1"), int(number("outputs"))};
    const double angle = number("start") * M_PI / 180.0, seconds = number("seconds");
    const std::string mode = given["mode"];
    if (set.outputs < 2 || !(set.tolerance > 0.0) || !(set.t1 > 0.0)) return std::fprintf(stderr, "bad settings\n"), 2;

    if (mode == "gradient") {
        switch (int(number("parameters"))) {
            case 1: gradient<1>(angle, set, seconds); break;
            case 2: gradient<2>(angle, set, seconds); break;
            case 4: gradient<4>(angle, set, seconds); break;
            case 8: gradient<8>(angle, set, seconds); break;
            default: return std::fprintf(stderr, "parameters: 1, 2, 4 or 8\n"), 2;
        }
        return 0;
    }
    std::vector<double> starts = mode == "batch" ? read_numbers(given["starts"]) : std::vector<double>{angle};
    if (starts.empty()) return std::fprintf(stderr, "no starts\n"), 2;
    std::vector<double> out(starts.size() * size_t(set.outputs) * N, NAN);
    const Linkage<double> linkage(NUMBERS);
    Counts counts;
    const auto times = repeated(seconds, [&] {
        minimum_norms = 0;
        if (mode == "batch" && number("lanes") > 1) {
            counts = integrate_lanes(starts, set, out);
            return;
        }
        counts = Counts();
        for (size_t m = 0; m < starts.size(); m++) {
            double start[N];
            place(starts[m], start);
            const Counts one = integrate(linkage, start, set, reinterpret_cast<double(*)[N]>(&out[m * size_t(set.outputs) * N]));
            counts.accepted += one.accepted, counts.rejected += one.rejected, counts.right_hand_sides += one.right_hand_sides;
        }
    });
    if (!given["dump"].empty()) write_numbers(given["dump"], out.data(), out.size());
    print(times, counts, minimum_norms, "");
    return 0;
}
