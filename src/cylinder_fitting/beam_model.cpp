#include "dendro_slam/cylinder_fitting/beam_model.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "dendro_slam/geometry/cylinder.h"
#include "dendro_slam/geometry/so3.h"

namespace dendro {
namespace {

constexpr double kThinRay = 1e-6;

// A short side below this share of the long one does not change the profile.
constexpr double kRectangle = 0.03;

// Energy density of the projected rectangle, not normalised (1 at the centre).
double Density(double u, const Footprint& footprint) {
  const double distance = std::abs(u);
  if (footprint.half_slope_m <= kRectangle * footprint.half_width_m) {
    return distance <= footprint.half_width_m * (1.0 + 1e-9) ? 1.0 : 0.0;
  }
  if (distance <= footprint.half_width_m - footprint.half_slope_m) return 1.0;
  return std::max(0.0, (footprint.reach() - distance) / (2.0 * footprint.half_slope_m));
}

// Share of the projected rectangle below u.
double ShareBelow(double u, const Footprint& footprint) {
  const double w = footprint.half_width_m, h = footprint.half_slope_m;
  if (h <= kRectangle * w) return std::clamp(0.5 + 0.5 * u / w, 0.0, 1.0);
  const double distance = std::abs(u);
  if (distance >= w + h) return u > 0.0 ? 1.0 : 0.0;
  const double beyond = distance <= w - h
                            ? 0.5 - 0.5 * distance / w
                            : (w + h - distance) * (w + h - distance) / (8.0 * w * h);
  return u > 0.0 ? 1.0 - beyond : beyond;
}

// Integrals over the part of the footprint within the silhouette; y' = y + u is a ray's offset and
// g = sqrt(Y^2 - y'^2) both its depth and, over Y, its cosine of incidence.
struct LimbIntegrals {
  double energy = 0.0, energy_y = 0.0, energy_Y = 0.0;  // of w g
  double depth = 0.0, depth_y = 0.0, depth_Y = 0.0;     // of w g^2
  double shift = 0.0, shift_y = 0.0, shift_Y = 0.0;     // of w g u
};

// Far from the limb the integrands are smooth: Gauss' rule with three nodes for the trapezoid's own
// weight, whose moments are those of the sum of two uniform variables. Off by less than 3e-5 Y where
// `reach` is at most kSmooth times the distance to the limb.
constexpr double kSmooth = 0.5;

LimbIntegrals IntegrateSmooth(double y, double Y, const Footprint& footprint) {
  const double w2 = footprint.half_width_m * footprint.half_width_m;
  const double h2 = footprint.half_slope_m * footprint.half_slope_m;
  const double second = (w2 + h2) / 3.0;
  const double fourth = (w2 * w2 + h2 * h2) / 5.0 + 2.0 / 3.0 * w2 * h2;
  const double node = std::sqrt(fourth / second);
  const double outer = 0.5 * second * second / fourth;
  const double area = 2.0 * footprint.half_width_m;
  LimbIntegrals sum;
  for (int k = -1; k <= 1; ++k) {
    const double u = k * node;
    const double y_ray = y + u;
    const double wg = area * (k == 0 ? 1.0 - 2.0 * outer : outer);
    const double g = std::sqrt(Y * Y - y_ray * y_ray);
    const double w = wg / g;
    sum.energy += wg * g;
    sum.energy_y -= w * y_ray;
    sum.energy_Y += w * Y;
    sum.depth += wg * g * g;
    sum.depth_y -= 2.0 * wg * y_ray;
    sum.depth_Y += 2.0 * wg * Y;
    sum.shift += wg * g * u;
    sum.shift_y -= w * u * y_ray;
    sum.shift_Y += w * u * Y;
  }
  return sum;
}

// Integrals up to an offset y' = Y sin(theta): of sin^k dtheta and of sin^k cos dtheta. The
// substitution takes the square-root singularity of the limb out.
struct SineIntegrals {
  std::array<double, 5> angle;
  std::array<double, 4> sine;

  explicit SineIntegrals(double s) {
    const double c = std::sqrt(std::max(0.0, 1.0 - s * s));
    const double s2 = s * s;
    angle[0] = std::asin(s);
    angle[1] = -c;
    angle[2] = 0.5 * (angle[0] - s * c);
    angle[3] = -c * (1.0 - c * c / 3.0);
    angle[4] = 0.75 * angle[2] - 0.25 * s2 * s * c;
    sine = {s, s2 / 2.0, s2 * s / 3.0, s2 * s2 / 4.0};
  }
};

LimbIntegrals Integrate(double y, double Y, const Footprint& footprint) {
  const double reach = footprint.reach();
  if (reach < kSmooth * (Y - std::abs(y))) return IntegrateSmooth(y, Y, footprint);
  // The density is a line in u, so in sin(theta), on each of three pieces: everything is a sum of
  // SineIntegrals.
  LimbIntegrals sum;
  const auto sine_at = [&](double u) { return std::clamp((y + u) / Y, -1.0, 1.0); };
  const auto add = [&](const SineIntegrals& low, const SineIntegrals& high, double p, double q) {
    std::array<double, 5> I;
    std::array<double, 4> S;
    for (std::size_t k = 0; k < I.size(); ++k) I[k] = high.angle[k] - low.angle[k];
    for (std::size_t k = 0; k < S.size(); ++k) S[k] = high.sine[k] - low.sine[k];
    // Density times u is u0 + u1 sin + u2 sin^2.
    const double u0 = -y * p, u1 = Y * p - y * q, u2 = Y * q;
    sum.energy += Y * Y * (p * (I[0] - I[2]) + q * (I[1] - I[3]));
    sum.energy_y -= Y * (p * I[1] + q * I[2]);
    sum.energy_Y += Y * (p * I[0] + q * I[1]);
    sum.depth += Y * Y * Y * (p * (S[0] - S[2]) + q * (S[1] - S[3]));
    sum.depth_y -= 2.0 * Y * Y * (p * S[1] + q * S[2]);
    sum.depth_Y += 2.0 * Y * Y * (p * S[0] + q * S[1]);
    sum.shift += Y * Y * (u0 * (I[0] - I[2]) + u1 * (I[1] - I[3]) + u2 * (I[2] - I[4]));
    sum.shift_y -= Y * (u0 * I[1] + u1 * I[2] + u2 * I[3]);
    sum.shift_Y += Y * (u0 * I[0] + u1 * I[1] + u2 * I[2]);
  };
  if (footprint.half_slope_m <= kRectangle * footprint.half_width_m) {
    add(SineIntegrals(sine_at(-footprint.half_width_m)),
        SineIntegrals(sine_at(footprint.half_width_m)), 1.0, 0.0);
    return sum;
  }
  const double inner = footprint.half_width_m - footprint.half_slope_m;
  const double slope = 0.5 / footprint.half_slope_m;
  const SineIntegrals begin(sine_at(-reach)), rise(sine_at(-inner)), fall(sine_at(inner)),
      end(sine_at(reach));
  add(begin, rise, (reach - y) * slope, Y * slope);
  add(rise, fall, 1.0, 0.0);
  add(fall, end, (reach + y) * slope, -Y * slope);
  return sum;
}

}  // namespace

Cone Cone::Retract(const Vector6d& delta) const {
  const Eigen::Matrix<double, 3, 2> B = PerpendicularBasis(axis);
  Cone out;
  out.axis = (ExpSo3(B * delta.head<2>()) * axis).normalized();
  out.point = point + B * delta.segment<2>(2);
  out.radius = radius + delta[4];
  out.slope = slope + delta[5];
  return out;
}

Cone BentCone::Touching(double s, TouchJacobian* jacobian) const {
  Cone cone;
  const Eigen::Vector3d moved = s * middle.axis + 0.5 * s * s * bend;
  cone.axis = (middle.axis + s * bend).normalized();
  cone.point = middle.point + moved;
  cone.radius = middle.radius + s * middle.slope;
  cone.slope = middle.slope;
  if (jacobian == nullptr) return cone;
  const Eigen::Matrix<double, 3, 2> basis = PerpendicularBasis(middle.axis);
  const Eigen::Matrix<double, 3, 2> own = PerpendicularBasis(cone.axis);
  jacobian->setZero();
  for (int k = 0; k < 2; ++k) {
    const Eigen::Vector3d b = basis.col(k);
    const Eigen::Vector3d turned = b.cross(moved);  // Of the point, when the axis turns about b.
    const Eigen::Vector3d bent = (0.5 * s * s) * b;
    jacobian->block<2, 1>(0, k) = own.transpose() * b;
    jacobian->block<2, 1>(2, k) = own.transpose() * turned;
    jacobian->block<2, 1>(2, 2 + k) = own.transpose() * b;
    jacobian->block<2, 1>(0, 6 + k) = own.transpose() * cone.axis.cross(s * b);
    jacobian->block<2, 1>(2, 6 + k) = own.transpose() * bent;
    // A shift along the axis changes the radius that is met at a place.
    (*jacobian)(4, k) = -cone.slope * cone.axis.dot(turned);
    (*jacobian)(4, 2 + k) = -cone.slope * cone.axis.dot(b);
    (*jacobian)(4, 6 + k) = -cone.slope * cone.axis.dot(bent);
  }
  (*jacobian)(4, 4) = 1.0;
  (*jacobian)(4, 5) = s;
  (*jacobian)(5, 5) = 1.0;
  return cone;
}

double BentCone::StationOf(const Eigen::Vector3d& origin, const Eigen::Vector3d& direction) const {
  const Eigen::Vector3d v = origin - middle.point;
  const double c = direction.dot(middle.axis);
  const double m2 = 1.0 - c * c;
  if (!(m2 > 1e-6)) return 0.0;
  return (v.dot(middle.axis) - c * v.dot(direction)) / m2;
}

BentCone BentCone::Retract(const Tangent& delta) const {
  const Eigen::Matrix<double, 3, 2> basis = PerpendicularBasis(middle.axis);
  BentCone out;
  out.middle = middle.Retract(delta.head<6>());
  out.bend = ExpSo3(basis * delta.head<2>()) * (bend + basis * delta.tail<2>());
  return out;
}

Footprint FootprintOnCone(const Eigen::Vector3d& axis,
                          const Eigen::Vector3d& direction,
                          const Eigen::Vector3d& spin_axis,
                          double half_horizontal_m,
                          double half_vertical_m) {
  const double c = axis.dot(direction);
  const double m2 = 1.0 - c * c;
  const Eigen::Vector3d across = spin_axis.cross(direction);
  const double across_norm = across.norm();
  Footprint footprint;
  if (m2 < 1e-6 || across_norm < 1e-6) {
    footprint.half_width_m = std::max(half_horizontal_m, half_vertical_m);
    return footprint;
  }
  const double m = std::sqrt(m2);
  const Eigen::Vector3d horizontal = across / across_norm;
  const Eigen::Vector3d vertical = direction.cross(horizontal);
  const Eigen::Vector3d u = axis.cross(direction) / m;
  const Eigen::Vector3d v = (axis - c * direction) / m;
  const double uh = std::abs(u.dot(horizontal)) * half_horizontal_m;
  const double uv = std::abs(u.dot(vertical)) * half_vertical_m;
  footprint.half_width_m = std::max(uh, uv);
  footprint.half_slope_m = std::min(uh, uv);
  // E[v | u] ~ (cov_uv / cov_uu) u; v metres along the axis' image lengthen the range by
  // v cot(angle between beam and axis).
  const double hh = half_horizontal_m * half_horizontal_m;
  const double vv = half_vertical_m * half_vertical_m;
  const double covariance = hh * u.dot(horizontal) * v.dot(horizontal) +
                            vv * u.dot(vertical) * v.dot(vertical);
  const double variance = uh * uh + uv * uv;
  if (variance > 0.0) footprint.skew = covariance / variance * c / m;
  return footprint;
}

BeamOnCone LocateBeam(const Cone& cone,
                      const Eigen::Vector3d& origin,
                      const Eigen::Vector3d& direction) {
  const Eigen::Matrix<double, 3, 2> basis = PerpendicularBasis(cone.axis);
  const Eigen::Vector3d& a = cone.axis;
  const Eigen::Vector3d& d = direction;
  const Eigen::Vector3d v = origin - cone.point;
  const double k = cone.slope;
  const double s0 = v.dot(a);
  const double c = d.dot(a);
  const double R0 = cone.radius + k * s0;
  const double A = 1.0 - c * c - k * k * c * c;
  const double B = v.dot(d) - s0 * c - k * c * R0;
  const double C = v.squaredNorm() - s0 * s0 - R0 * R0;
  const double m2 = 1.0 - c * c;
  BeamOnCone out;
  if (!(A > 1e-6) || !(m2 > 1e-6)) return out;
  const double m = std::sqrt(m2);
  const Eigen::Vector3d axd = a.cross(d);
  const double y = v.dot(axd) / m;
  const double Y2 = y * y + B * B / A - C;
  if (!(Y2 > 1e-12)) return out;
  const double Y = std::sqrt(Y2);

  // Turning the axis: da = (B alpha) x a = alpha_1 (b1 x a) + alpha_2 (b2 x a) = -alpha_1 b2 + alpha_2 b1.
  Eigen::Matrix<double, 3, 2> da;
  da.col(0) = -basis.col(1);
  da.col(1) = basis.col(0);
  Vector6d ds0 = Vector6d::Zero(), dc = Vector6d::Zero(), dR0 = Vector6d::Zero();
  ds0.head<2>() = da.transpose() * v;
  dc.head<2>() = da.transpose() * d;
  dR0 = k * ds0;
  dR0[4] += 1.0;
  dR0[5] += s0;
  Vector6d dA = -2.0 * c * (1.0 + k * k) * dc;
  dA[5] -= 2.0 * k * c * c;
  Vector6d dB = -c * ds0 - s0 * dc - k * c * dR0 - R0 * k * dc;
  dB.segment<2>(2) -= basis.transpose() * d;
  dB[5] -= R0 * c;
  Vector6d dC = -2.0 * s0 * ds0 - 2.0 * R0 * dR0;
  dC.segment<2>(2) -= 2.0 * basis.transpose() * v;
  // y = N / m with N = v . (a x d).
  Vector6d dN = Vector6d::Zero();
  dN.head<2>() = da.transpose() * d.cross(v);
  dN.segment<2>(2) = -basis.transpose() * axd;
  const Vector6d dm = -c / m * dc;

  out.valid = true;
  out.offset = y;
  out.silhouette = Y;
  out.mid_range = -B / A;
  out.sin_angle = std::sqrt(A);
  out.d_offset = (dN - y * dm) / m;
  out.d_silhouette =
      (y * out.d_offset + (B / A) * dB - 0.5 * B * B / (A * A) * dA - 0.5 * dC) / Y;
  out.d_mid_range = -dB / A + B / (A * A) * dA;
  out.d_sin_angle = 0.5 / out.sin_angle * dA;
  return out;
}

RangePrediction PredictRange(const BeamOnCone& beam, const Footprint& footprint) {
  const double y = beam.offset;
  const double Y = beam.silhouette;
  RangePrediction out;
  double depth = 0.0, depth_y = 0.0, depth_Y = 0.0;
  double shift = 0.0, shift_y = 0.0, shift_Y = 0.0;
  if (footprint.reach() < kThinRay) {
    if (std::abs(y) < Y) {
      depth = std::sqrt(Y * Y - y * y);
      const double inverse = 1.0 / std::max(depth, 0.1 * Y);
      depth_y = -y * inverse;
      depth_Y = Y * inverse;
      out.energy = beam.sin_angle * depth / Y;
    }
  } else {
    const LimbIntegrals sum = Integrate(y, Y, footprint);
    if (sum.energy > 1e-9 * Y * footprint.reach()) {
      const double inverse = 1.0 / sum.energy;
      depth = sum.depth * inverse;
      depth_y = (sum.depth_y - depth * sum.energy_y) * inverse;
      depth_Y = (sum.depth_Y - depth * sum.energy_Y) * inverse;
      shift = sum.shift * inverse;
      shift_y = (sum.shift_y - shift * sum.energy_y) * inverse;
      shift_Y = (sum.shift_Y - shift * sum.energy_Y) * inverse;
      out.energy = beam.sin_angle * sum.energy / (Y * 2.0 * footprint.half_width_m);
    }
  }
  const double inverse = 1.0 / beam.sin_angle;
  out.range = beam.mid_range - depth * inverse + footprint.skew * shift;
  out.jacobian = beam.d_mid_range + depth * inverse * inverse * beam.d_sin_angle +
                 (footprint.skew * shift_y - depth_y * inverse) * beam.d_offset +
                 (footprint.skew * shift_Y - depth_Y * inverse) * beam.d_silhouette;
  return out;
}

double DetectionOffset(double silhouette,
                       double sin_angle,
                       const Footprint& footprint,
                       double share,
                       double competing,
                       double* d_silhouette) {
  const double Y = silhouette;
  if (d_silhouette != nullptr) *d_silhouette = 1.0;
  if (footprint.reach() < kThinRay) return Y;
  const double area = 2.0 * footprint.half_width_m;
  const auto met = [&](double e) { return ShareBelow(Y - e, footprint) - ShareBelow(-Y - e, footprint); };
  // Both conditions fall with the offset; the smaller root is the answer.
  const auto root = [&](auto excess, auto slope) {
    double low = 0.0;
    double high = Y + footprint.reach();
    double e = Y;
    if (excess(0.0) <= 0.0) return 0.0;
    for (int i = 0; i < 60; ++i) {
      const double value = excess(e);
      (value > 0.0 ? low : high) = e;
      const double s = slope(e);
      double next = s < 0.0 ? e - value / s : low;
      if (!(next > low && next < high)) next = 0.5 * (low + high);
      const bool done = std::abs(next - e) < 1e-8;
      e = next;
      if (done) break;
    }
    return e;
  };
  const auto density = [&](double e) { return Density(Y - e, footprint) - Density(Y + e, footprint); };
  double e = root([&](double x) { return met(x) - share; },
                  [&](double x) { return -density(x) / area; });
  if (competing > 0.0) {
    const double scale = sin_angle / (Y * area);
    const double visible =
        root([&](double x) { return scale * Integrate(x, Y, footprint).energy - competing * (1.0 - met(x)); },
             [&](double x) {
               return scale * Integrate(x, Y, footprint).energy_y - competing * density(x) / area;
             });
    if (visible < e) {
      if (d_silhouette != nullptr) *d_silhouette = visible > 0.0 ? 1.0 : 0.0;
      return visible;
    }
  }
  if (d_silhouette != nullptr) {
    const double near = Density(Y - e, footprint);
    const double far = Density(Y + e, footprint);
    *d_silhouette = e <= 0.0 ? 0.0 : near > far ? (near + far) / (near - far) : 1.0;
  }
  return e;
}

}  // namespace dendro
