#pragma once

#include <cmath>
#include <cstdint>

#include <Eigen/Core>

/// The narrow phase: a ray against one primitive, exactly. Every function returns the smallest range
/// in [min, max] or infinity.
namespace dendro {

constexpr double kNoHit = 1e300;

/// A conical frustum without its ends, with the joints and caps of a branch's chain (SceneBranch).
struct Cone {
  enum class End : std::uint8_t { kOpen, kDisc, kJoint };

  Eigen::Vector3d base = Eigen::Vector3d::Zero();
  Eigen::Vector3d axis = Eigen::Vector3d::UnitZ();  ///< Unit, from base to tip.
  double length_m = 0.0;
  double base_radius_m = 0.0;
  double slope = 0.0;                               ///< dr/ds.
  End base_end = End::kOpen;                        ///< kDisc: flat, radius base_radius_m.
  End tip_end = End::kOpen;                         ///< kJoint: sphere wedge to the next piece.
  double base_disc_m = 0.0;                         ///< Radius of the flat disc at the base.
  double tip_disc_m = 0.0;                          ///< Radius of the flat disc at the tip.
  Eigen::Vector3d next_axis = Eigen::Vector3d::UnitZ();  ///< Axis of the next piece (kJoint).

  double TipRadius() const { return base_radius_m + slope * length_m; }
  Eigen::Vector3d Tip() const { return base + length_m * axis; }
};

struct Sphere {
  Eigen::Vector3d centre = Eigen::Vector3d::Zero();
  double radius_m = 0.0;
};

struct Box {
  Eigen::Vector3d centre = Eigen::Vector3d::Zero();
  Eigen::Vector3d half_m = Eigen::Vector3d::Ones();
  double cos_yaw = 1.0, sin_yaw = 0.0;

  Eigen::Vector3d ToBox(const Eigen::Vector3d& v) const {
    return {cos_yaw * v.x() + sin_yaw * v.y(), -sin_yaw * v.x() + cos_yaw * v.y(), v.z()};
  }
  Eigen::Vector3d FromBox(const Eigen::Vector3d& v) const {
    return {cos_yaw * v.x() - sin_yaw * v.y(), sin_yaw * v.x() + cos_yaw * v.y(), v.z()};
  }
};

struct Triangle {
  Eigen::Vector3d a = Eigen::Vector3d::Zero();
  Eigen::Vector3d ab = Eigen::Vector3d::UnitX();
  Eigen::Vector3d ac = Eigen::Vector3d::UnitY();
};

/// Ray against a flat disc.
inline double IntersectDisc(const Eigen::Vector3d& o,
                            const Eigen::Vector3d& d,
                            const Eigen::Vector3d& centre,
                            const Eigen::Vector3d& normal,
                            double radius_m,
                            double min_m,
                            double max_m) {
  const double dn = d.dot(normal);
  if (dn == 0.0) return kNoHit;
  const double t = (centre - o).dot(normal) / dn;
  if (!(t >= min_m && t <= max_m)) return kNoHit;
  const Eigen::Vector3d r = o + t * d - centre;
  return r.squaredNorm() <= radius_m * radius_m ? t : kNoHit;
}

/// Ray against a sphere, both its sides.
inline double IntersectSphere(const Eigen::Vector3d& o,
                              const Eigen::Vector3d& d,
                              const Eigen::Vector3d& centre,
                              double radius_m,
                              double min_m,
                              double max_m) {
  const Eigen::Vector3d m = o - centre;
  const double b = m.dot(d);
  const Eigen::Vector3d foot = m - b * d;  // Perpendicular part: no cancellation far away.
  const double h2 = radius_m * radius_m - foot.squaredNorm();
  if (h2 < 0.0) return kNoHit;
  const double h = std::sqrt(h2);
  if (-b - h >= min_m && -b - h <= max_m) return -b - h;
  if (-b + h >= min_m && -b + h <= max_m) return -b + h;
  return kNoHit;
}

/// Ray against a cone with its ends. Substituting p = o + t d into |p_perp| = r0 + k s gives
/// A t^2 + 2 B t + C = 0 with A = 1 - (1 + k^2) (d.a)^2, solved from the point of the ray next to the
/// cone's middle so that nothing cancels.
/// @param normal  Receives the outward normal at the hit.
inline double IntersectCone(const Eigen::Vector3d& o,
                            const Eigen::Vector3d& d,
                            const Cone& cone,
                            double min_m,
                            double max_m,
                            Eigen::Vector3d* normal) {
  double best = kNoHit;
  const double da = d.dot(cone.axis);
  const double shift = (cone.base + 0.5 * cone.length_m * cone.axis - o).dot(d);
  const Eigen::Vector3d m = o + shift * d - cone.base;
  const double ma = m.dot(cone.axis);
  const double radius = cone.base_radius_m + cone.slope * ma;
  const double a = 1.0 - (1.0 + cone.slope * cone.slope) * da * da;
  const double b = m.dot(d) - ma * da - cone.slope * radius * da;
  const double c = m.squaredNorm() - ma * ma - radius * radius;
  const double disc = b * b - a * c;
  const auto side = [&](double t) {
    const double range = t + shift;
    const double s = ma + t * da;
    if (!(range >= min_m && range <= max_m && range < best)) return;
    if (!(s >= 0.0 && s <= cone.length_m)) return;
    if (radius + cone.slope * t * da < 0.0) return;  // The mirrored half of the double cone.
    best = range;
    const Eigen::Vector3d radial = m + t * d - s * cone.axis;
    const double norm = radial.norm();
    *normal = norm > 0.0 ? Eigen::Vector3d((radial / norm - cone.slope * cone.axis).normalized())
                         : cone.axis;
  };
  if (disc >= 0.0) {
    if (std::abs(a) > 1e-12) {
      const double root = std::sqrt(disc);
      const double q = b >= 0.0 ? -(b + root) : -(b - root);
      const double t1 = q / a;
      const double t2 = q != 0.0 ? c / q : t1;
      side(t1 < t2 ? t1 : t2);
      if (best == kNoHit) side(t1 < t2 ? t2 : t1);
    } else if (b != 0.0) {
      side(-0.5 * c / b);
    }
  }
  if (cone.base_end == Cone::End::kDisc) {
    const double t = IntersectDisc(o, d, cone.base, cone.axis, cone.base_disc_m, min_m, max_m);
    if (t < best) {
      best = t;
      *normal = -cone.axis;
    }
  }
  if (cone.tip_end == Cone::End::kDisc) {
    const double t = IntersectDisc(o, d, cone.Tip(), cone.axis, cone.tip_disc_m, min_m, max_m);
    if (t < best) {
      best = t;
      *normal = cone.axis;
    }
  } else if (cone.tip_end == Cone::End::kJoint) {
    // The wedge between the end plane of this piece and the start plane of the next.
    const Eigen::Vector3d centre = cone.Tip();
    const double r = cone.TipRadius();
    const Eigen::Vector3d mc = o - centre;
    const double bs = mc.dot(d);
    const double h2 = r * r - (mc - bs * d).squaredNorm();
    if (h2 >= 0.0) {
      const double h = std::sqrt(h2);
      for (const double t : {-bs - h, -bs + h}) {
        if (!(t >= min_m && t <= max_m && t < best)) continue;
        const Eigen::Vector3d p = mc + t * d;
        if (p.dot(cone.axis) < 0.0 || p.dot(cone.next_axis) > 0.0) continue;
        best = t;
        *normal = p / r;
        break;
      }
    }
  }
  return best;
}

/// Ray against a box; from inside, the wall it leaves through.
inline double IntersectBox(const Eigen::Vector3d& o,
                           const Eigen::Vector3d& d,
                           const Box& box,
                           double min_m,
                           double max_m,
                           Eigen::Vector3d* normal) {
  const Eigen::Vector3d m = box.ToBox(o - box.centre);
  const Eigen::Vector3d v = box.ToBox(d);
  double enter = -kNoHit, leave = kNoHit;
  int enter_axis = 0, leave_axis = 0;
  for (int i = 0; i < 3; ++i) {
    if (v[i] == 0.0) {
      if (std::abs(m[i]) > box.half_m[i]) return kNoHit;
      continue;
    }
    const double h = v[i] > 0.0 ? box.half_m[i] : -box.half_m[i];
    const double near = (-h - m[i]) / v[i];
    const double far = (h - m[i]) / v[i];
    if (near > enter) {
      enter = near;
      enter_axis = i;
    }
    if (far < leave) {
      leave = far;
      leave_axis = i;
    }
  }
  if (enter > leave) return kNoHit;
  const auto face = [&](int axis, double sign) {
    Eigen::Vector3d n = Eigen::Vector3d::Zero();
    n[axis] = sign * (v[axis] > 0.0 ? 1.0 : -1.0);
    *normal = box.FromBox(n);
  };
  if (enter >= min_m && enter <= max_m) {
    face(enter_axis, -1.0);
    return enter;
  }
  if (leave >= min_m && leave <= max_m) {
    face(leave_axis, 1.0);
    return leave;
  }
  return kNoHit;
}

/// Ray against a triangle (Moeller and Trumbore 1997), both sides; edges belong to it.
inline double IntersectTriangle(const Eigen::Vector3d& o,
                                const Eigen::Vector3d& d,
                                const Triangle& triangle,
                                double min_m,
                                double max_m) {
  const Eigen::Vector3d p = d.cross(triangle.ac);
  const double det = triangle.ab.dot(p);
  if (det == 0.0) return kNoHit;
  const double inverse = 1.0 / det;
  const Eigen::Vector3d s = o - triangle.a;
  // A hair of tolerance: a ray through a shared edge meets at least one of the two triangles.
  constexpr double kEdge = 1e-12;
  const double u = s.dot(p) * inverse;
  if (u < -kEdge || u > 1.0 + kEdge) return kNoHit;
  const Eigen::Vector3d q = s.cross(triangle.ab);
  const double v = d.dot(q) * inverse;
  if (v < -kEdge || u + v > 1.0 + kEdge) return kNoHit;
  const double t = triangle.ac.dot(q) * inverse;
  return t >= min_m && t <= max_m ? t : kNoHit;
}

}  // namespace dendro
