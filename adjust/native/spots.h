// Least-squares fit of luminous spots: a Gaussian integrated over the pixels, or a disc with a soft edge.
#pragma once
#include "fits.h"

namespace {

constexpr int SPOT = 7;  // u, v, background, amplitude, log widths u and v, log softness
enum Profile : int64_t { GAUSSIAN, DISC };
constexpr double ROOT_HALF = 0.7071067811865476;

inline double normal_density(double x) { return 0.3989422804014327 * std::exp(-0.5 * x * x); }

// Grey value and derivatives. Gaussian: amplitude is the flux, widths are standard deviations (no softness). Disc:
// amplitude is the step, widths are radii and the softness is the standard deviation of the blurred rim.
struct SpotProfile {
    const double *p;
    Profile profile;
    double wu, wv, soft;

    SpotProfile(const double *at, Profile which) : p(at), profile(which), wu(std::exp(p[4])), wv(std::exp(p[5])), soft(std::exp(p[6])) {}

    // Share of a Gaussian on a pixel at distance d from it in one direction, its derivatives by d and log sigma.
    static double share(double d, double sigma, double &by_d, double &by_width) {
        const double a = (d - 0.5) / sigma, b = (d + 0.5) / sigma, pa = normal_density(a), pb = normal_density(b);
        by_d = (pb - pa) / sigma, by_width = a * pa - b * pb;
        return 0.5 * (std::erfc(-b * ROOT_HALF) - std::erfc(-a * ROOT_HALF));
    }
    double operator()(double x, double y, double *d) const {
        d[2] = 1.0, d[6] = 0.0;
        if (profile == GAUSSIAN) {
            double xd, xs, yd, ys;
            const double gx = share(x - p[0], wu, xd, xs), gy = share(y - p[1], wv, yd, ys), f = gx * gy;
            d[0] = -p[3] * xd * gy, d[1] = -p[3] * gx * yd, d[3] = f, d[4] = p[3] * xs * gy, d[5] = p[3] * gx * ys;
            return p[2] + p[3] * f;
        }
        const double ex = (x - p[0]) / wu, ey = (y - p[1]) / wv, rho = larger(root(ex * ex + ey * ey), 1e-9), scale = root(wu * wv) / soft;
        const double t = (rho - 1.0) * scale, f = 0.5 * std::erfc(t * ROOT_HALF), g = -p[3] * normal_density(t);
        d[0] = -g * scale * ex / (wu * rho), d[1] = -g * scale * ey / (wv * rho), d[3] = f;
        d[4] = g * (0.5 * t - scale * ex * ex / rho), d[5] = g * (0.5 * t - scale * ey * ey / rho), d[6] = -g * t;
        return p[2] + p[3] * f;
    }
};

// Each spot with both profiles, of which the better one is kept. labels: component of each pixel, 0 none; pixels of other
// components are left out, and those at or above saturation. Results as survey.detection.spots takes them; best -1 where
// none converged. work: scratch, three times the pixels of the largest window.
inline void fit_spots(In<float, 2> gray, In<int64_t, 2> labels, double saturation, In<double, 2> start, Ints label, Vector diameter, Vector peak,
                      Vector background, Out<double, 2> out, Out<int64_t, 1> best, Out<double, 3> cov, Out<double, 1> rms,
                      Out<int64_t, 1> saturated, Out<double, 1> work) {
    const int64_t most = work.n[0] / 3;
    double *x = work.data, *y = x + most, *value = y + most;
    const auto clamp = [](double *p) {
        for (int i = 4; i < SPOT; ++i) p[i] = smaller(larger(p[i], std::log(0.15)), std::log(100.0));
    };
    for (int64_t c = 0; c < start.n[0]; ++c) {
        if (!lies_on(gray, start(c, 0), start(c, 1)) || !(magnitude(diameter[c]) < LARGEST_WINDOW)) continue;
        const int64_t u0 = std::lrint(start(c, 0)), v0 = std::lrint(start(c, 1)), reach = int64_t(std::ceil(diameter[c] + 3.0));
        int n = 0;
        for (int64_t j = larger(-reach, -v0); j <= smaller(reach, gray.n[0] - 1 - v0); ++j)
            for (int64_t i = larger(-reach, -u0); i <= smaller(reach, gray.n[1] - 1 - u0); ++i) {
                const int64_t other = labels(v0 + j, u0 + i);
                if (i * i + j * j > reach * reach || (other != 0 && other != label[c])) continue;
                if (gray(v0 + j, u0 + i) >= saturation) ++saturated.data[c];
                else if (n < most) x[n] = double(i), y[n] = double(j), value[n++] = gray(v0 + j, u0 + i);
            }
        if (n >= 14) {
            const Pixels w{x, y, value, n};
            double lowest = -1.0;
            for (const Profile profile : {GAUSSIAN, DISC}) {
                const double width = larger(diameter[c] / 2.355, 0.4);
                double p[SPOT] = {start(c, 0) - double(u0), start(c, 1) - double(v0), background[c]};
                p[3] = profile == GAUSSIAN ? peak[c] * 2.0 * M_PI * width * width : peak[c];
                p[4] = p[5] = profile == GAUSSIAN ? std::log(width) : std::log(larger(diameter[c] / 2.0, 0.5));
                p[6] = std::log(0.8);
                const int n_free = profile == GAUSSIAN ? 6 : 7;
                Normals<SPOT> at;
                const auto evaluate = [&](const double *q, Normals<SPOT> &o) { add_pixels(w, SpotProfile(q, profile), o); };
                evaluate(p, at);
                if (!levenberg_marquardt(p, n_free, 2e-5, evaluate, clamp, at)) continue;
                const double variance = at.cost / (n - n_free);
                double here[4], rim[4];
                if ((lowest >= 0.0 && variance >= lowest) || !place_covariance(at, n_free, variance, here)) continue;
                // of a full spot only the rim tells the place, while the background around it says how well the model fits
                if (saturated.data[c] > 0 && place_covariance_by_pixel(at, n_free, w, SpotProfile(p, profile), rim) &&
                    rim[0] + rim[3] > here[0] + here[3])
                    std::memcpy(here, rim, sizeof here);
                lowest = variance, best.data[c] = profile, rms.data[c] = root(variance);
                std::memcpy(&out(c, 0), p, sizeof p), std::memcpy(&cov(c, 0, 0), here, sizeof here);
            }
        }
        out(c, 0) += double(u0), out(c, 1) += double(v0);
    }
}

// Grey values (n,) at places xy (n, 2), and their derivatives (n, 7).
inline void spot_profile(In<double, 2> xy, Vector p, int64_t profile, Out<double, 1> value, Out<double, 2> rows) {
    const SpotProfile spot(p.data, profile == GAUSSIAN ? GAUSSIAN : DISC);
    for (int64_t i = 0; i < xy.n[0]; ++i) value.data[i] = spot(xy(i, 0), xy(i, 1), &rows(i, 0));
}

}  // namespace
