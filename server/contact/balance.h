#pragma once

#include <cmath>

#include "contact/friction.h"
#include "contact/line.h"
#include "contact/link.h"
#include "contact/links.h"
#include "contact/surface.h"
#include "contact/tilt.h"
#include "view/scene.h"

/// Balances the momentum of free bodies after a solve. Forces alone change the momentum of a body that nothing holds:
///
///   Σ m (v − v̂) = h Σ F        Σ r × m (v − v̂) = h Σ r × F        r: from the body's centre row
///
/// A step that is linearized once misses that for two reasons:
///
/// 1. A solve that ends at its tolerance leaves a residual. Its sum over a body is a force that nobody exerts: a block
///    dropped flat on a smooth table would leave it sideways.
/// 2. Friction enters the solve with a secant (friction.h). Where a body gains or loses speed, that is not μ N.
///
/// So the body gets the rigid motion c = (w, ω) that restores both equations, with friction at Coulomb's limit:
///
///   v += w + ω × r,   u += h (w + ω × r)
///   (Σ m Tᵀ T + h² Σ Tᵀ K T) c = defect       T = [I, −[r]×];  K: stiffness of contacts, links and friction
///
///   begin ─> v̂ ... solve ... measure ─> sums of each patch ─> solve ─> c of each body ─> apply (solver/balance.h)
///                              ^──────────────────────────── a few times ────────────────────────┘
///
/// 3. Internal forces have neither a sum nor a moment at the end of a step, so they do not occur.
/// 4. A contact that slides keeps its force μ N ξ / |ξ| under c, but for its turn: K has no part along ξ. If c would
///    reverse the slip, K has the secant μ N / |ξ| there as well, which never does.
/// 5. Free bodies that links may join are partners. A link takes from one what it gives the other only if both
/// equations
///    know both motions, so those of all partners are solved as one system.
namespace tensormass::contact {

/// Force of friction on the tissue at Coulomb's limit, and how it changes with a motion of the tissue.
template <class Real>
struct CoulombForce {
  Vec3<Real> force = Vec3<Real>::Zero();
  Vec3<Real> slip = Vec3<Real>::Zero();  // direction of ξ, if it slides
  Real stick = 0;                        // resistance across n [N/m], but for a contact that slides along slip
  Real along = 0;                        // resistance along slip [N/m], 0 if it sticks: that of its secant

  /// Returns the force after a motion of the tissue. with_along: as in view::BodyCorrection.
  TM_HOST_DEVICE Vec3<Real> after(const Vec3<Real>& tangential_motion, bool with_along) const {
    const Vec3<Real> of_slip = slip * slip.dot(tangential_motion);
    const Vec3<Real> across = tangential_motion - of_slip;
    return force - across * stick - of_slip * (with_along ? along : Real(0));
  }
};

/// stretch: ξ. pressure: N; pulling counts as none.
template <class Real>
TM_HOST_DEVICE CoulombForce<Real> coulomb_force(Real stiffness, Real friction, const Vec3<Real>& stretch,
                                                Real pressure) {
  using std::sqrt;
  CoulombForce<Real> out;
  const Real most = friction * maximum(pressure, Real(0));
  if (!(most > 0)) return out;
  const Real yield = yield_factor(stiffness, stretch, most);
  out.stick = stiffness * yield;
  out.force = stretch * out.stick;
  if (yield < 1) {
    out.along = out.stick;
    out.slip = unit(stretch);
  }
  return out;
}

/// Takes v̂ of the rows of free bodies. Runs after `predict`.
/// Reads velocity; writes start_velocity.
template <class Team, class Real>
TM_HOST_DEVICE void begin_balance(const Team& team, const view::PatchesView& patches,
                                  const view::StateView<Real>& state, const view::BalanceView<Real>& balance) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    if (balance.row_body[row] == view::kNoBody) return;
    view::store3<Real>(balance.start_velocity, row, view::load3<Real>(state.velocity, row));
  });
}

/// The sums of an entry while they are gathered.
class Balance {
 public:
  TM_HOST_DEVICE view::BalanceSums& sums() { return sums_; }

  /// Adds an impulse at r [N s].
  TM_HOST_DEVICE void add_impulse(const Vec3<double>& r, const Vec3<double>& impulse) {
    const Vec3<double> moment = physics::cross<double>(r, impulse);
    for (int c = 0; c < 3; ++c) {
      sums_.defect[c] += impulse[c];
      sums_.defect[3 + c] += moment[c];
    }
  }
  /// Counts an impulse in the size of all.
  TM_HOST_DEVICE void add_size(const Vec3<double>& impulse) {
    using std::sqrt;
    sums_.sliding[view::kSizeOfImpulses] += sqrt(impulse.dot(impulse));
  }
  /// Adds Tᵀ K T_of to the stiffness. The sum over all pairs of points must be symmetric.
  TM_HOST_DEVICE void add_stiffness(const Vec3<double>& r, const Mat3<double>& k, const Vec3<double>& r_of) {
    // T = [I, −[r]×], Tᵀ = [I; [r]×].
    const Mat3<double> upper_right = -k * cross_matrix(r_of), lower_right = cross_matrix(r) * upper_right;
    std::size_t i = 0;
    for (int row = 0; row < 6; ++row) {
      for (int column = row; column < 6; ++column, ++i) {
        if (column < 3) {
          sums_.stiffness[i] += k(row, column);
        } else {
          sums_.stiffness[i] += row < 3 ? upper_right(row, column - 3) : lower_right(row - 3, column - 3);
        }
      }
    }
  }
  /// Adds s times u uᵀ to the stiffness.
  TM_HOST_DEVICE void add_stiffness(const double (&u)[6], double s) { add_outer(sums_.stiffness, u, s); }
  /// Adds a contact that slides. along: h² μN / |ξ|
  TM_HOST_DEVICE void add_sliding(const Vec3<double>& r, double pressure, const Vec3<double>& stretch,
                                  const Vec3<double>& slip, double along) {
    sums_.sliding[view::kSlidingN] += pressure;
    for (std::size_t c = 0; c < 3; ++c) {
      sums_.sliding[view::kSlidingSlip + c] += pressure * stretch[static_cast<Eigen::Index>(c)];
      sums_.sliding[view::kSlidingArm + c] += pressure * r[static_cast<Eigen::Index>(c)];
    }
    const Vec3<double> turned = physics::cross<double>(r, slip);
    const double u[6] = {slip[0], slip[1], slip[2], turned[0], turned[1], turned[2]};
    add_outer(sums_.along_slip, u, along);
  }

 private:
  TM_HOST_DEVICE static void add_outer(double (&triangle)[view::kBalanceTriangle], const double (&u)[6], double s) {
    std::size_t i = 0;
    for (int row = 0; row < 6; ++row) {
      for (int column = row; column < 6; ++column, ++i) triangle[i] += u[row] * u[column] * s;
    }
  }

  view::BalanceSums sums_{};
};

/// Adds a row of a free body: its momentum, gravity, loads and mass damping.
template <class Real>
TM_HOST_DEVICE void add_row(const view::StateView<Real>& state, const view::BalanceView<Real>& balance,
                            const Vec3<Real>& center, std::uint32_t row, Balance& out) {
  const Real h = view::step_size(state), mass = state.inertia[std::size_t{4} * row];
  const Real damping = state.inertia[std::size_t{4} * row + 1];
  const Vec3<double> r = (view::position(state, row) - center).template cast<double>();
  const Vec3<Real> v = view::load3<Real>(state.velocity, row), start = view::load3<Real>(balance.start_velocity, row);
  out.add_impulse(r, (start - v).template cast<double>() * static_cast<double>(mass) -
                         v.template cast<double>() * static_cast<double>(h * damping * mass));
  const double resisting = static_cast<double>(mass) * (1 + static_cast<double>(h * damping));
  out.add_stiffness(r, Mat3<double>::Identity() * resisting, r);
  if (state.external == nullptr) return;
  const Vec3<double> impulse = view::load3<Real>(state.external, row).template cast<double>() * static_cast<double>(h);
  out.add_impulse(r, impulse);
  out.add_size(impulse);
}

/// Adds a contact of a tool with a triangle of a free body.
template <class Real>
TM_HOST_DEVICE void add_contact(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                const Vec3<Real>& center, std::size_t place, std::uint32_t triangle, Real friction,
                                Balance& out) {
  const view::TriangleContact<Real>& touch = contact.contacts[place];
  if (!touches(touch)) return;
  const ContactPoint<Real> at(state, contact, triangle, touch);
  const Corners<Real> now = corners_of(state, contact, triangle), change = at.change_made();
  const double h = static_cast<double>(view::step_size(state));
  const double factor = static_cast<double>(view::contact_factor(state));
  const Vec3<Real> n = at.normal();
  const Real pressure = at.pressure_after(change);
  const Vec3<double> r = (now.at(at.weights()) - center).template cast<double>();
  Vec3<Real> push = n * pressure;
  Mat3<Real> k = n * n.transpose() * touch.stiffness;
  if (friction > 0) {
    const Vec3<Real> stretch = stretch_of(at, contact.frictions[place]);
    const CoulombForce<Real> drag = coulomb_force(touch.stiffness, friction, stretch, pressure);
    push += drag.force;
    k += (Mat3<Real>::Identity() - n * n.transpose() - drag.slip * drag.slip.transpose()) * drag.stick;
    if (drag.along > 0) {
      out.add_sliding(r, static_cast<double>(pressure), stretch.template cast<double>(),
                      drag.slip.template cast<double>(), static_cast<double>(drag.along) * factor);
    }
  }
  const Vec3<double> impulse = push.template cast<double>() * h;
  out.add_impulse(r, impulse);
  out.add_size(impulse);
  out.add_stiffness(r, k.template cast<double>() * factor, r);

  const Tilt<Real> tilt(at.corners_before(), touch);
  if (!(touch.line_stiffness > 0 || tilt.stiffness() > 0)) return;
  // The tilt of the six rigid motions.
  Corners<Real> motions[6];
  for (int i = 0; i < 6; ++i) {
    for (int c = 0; c < 3; ++c) {
      const Vec3<Real> axis = Vec3<Real>::Unit(i % 3);
      motions[i].x[c] = i < 3 ? axis : physics::cross<Real>(axis, now.x[c] - center);
    }
  }
  const auto add_force = [&](int corner, const Vec3<Real>& force) {
    out.add_impulse((now.x[corner] - center).template cast<double>(), force.template cast<double>() * h);
  };
  if (touch.line_stiffness > 0) {
    const LineTilt<Real> line(touch);
    double u[6];
    for (int i = 0; i < 6; ++i) u[i] = static_cast<double>(line.of(motions[i]));
    const Real tilted = line.of(change);
    for (int c = 0; c < 3; ++c) add_force(c, line.force(c, tilted));
    out.add_stiffness(u, static_cast<double>(touch.line_stiffness) * factor);
  }
  if (!(tilt.stiffness() > 0)) return;
  const Vec3<Real> tilted = tilt.of(change);
  for (int c = 0; c < 3; ++c) add_force(c, tilt.force(c, tilted));
  Vec3<Real> of_motion[6];
  for (int i = 0; i < 6; ++i) of_motion[i] = tilt.of(motions[i]);
  for (int c = 0; c < 3; ++c) {
    double u[6];
    for (int i = 0; i < 6; ++i) u[i] = static_cast<double>(of_motion[i][c]);
    out.add_stiffness(u, static_cast<double>(tilt.stiffness()) * factor);
  }
}

/// Adds the links of a row of a free body.
template <class Real>
TM_HOST_DEVICE void add_links(const view::StateView<Real>& state, const view::LinksView<Real>& links,
                              const view::BalanceView<Real>& balance, const Vec3<Real>& center, std::uint32_t row,
                              Balance& out) {
  using std::abs;
  const double h = static_cast<double>(view::step_size(state));
  const double factor = static_cast<double>(view::contact_factor(state));
  const auto arm_of = [&](std::uint32_t of_row) -> Vec3<Real> { return view::position(state, of_row) - center; };
  for_each_link(links, row, [&](const view::Link<Real>& link, std::uint32_t role) {
    const Vec3<double> r = arm_of(row).template cast<double>();
    const auto made = [&](std::uint32_t of_row) { return view::change_made_to_end(state, of_row); };
    const Vec3<double> impulse =
        force_after(link, made).template cast<double>() * (h * static_cast<double>(link.weight[role]));
    out.add_impulse(r, impulse);
    out.add_size(impulse);
    // What the other rows of the link that move with this body add to its motion.
    Real weight = 0;
    Vec3<Real> arm = Vec3<Real>::Zero();
    for (std::uint32_t other = 0; other < 4; ++other) {
      if (link.weight[other] == 0 || balance.row_body[link.rows[other]] != balance.row_body[row]) continue;
      weight += link.weight[other];
      arm += arm_of(link.rows[other]) * link.weight[other];
    }
    if (!(abs(weight) > Real(1e-3))) return;  // the link is within the body
    out.add_stiffness(
        r, stiffness_of(link).template cast<double>() * (factor * static_cast<double>(link.weight[role] * weight)),
        (arm / weight).template cast<double>());
  });
}

/// Adds how a partner's motion changes the impulses of the links of a row of a free body.
template <class Real>
TM_HOST_DEVICE void add_partner(const view::StateView<Real>& state, const view::LinksView<Real>& links,
                                const view::BalanceView<Real>& balance, const Vec3<Real>& center, std::uint32_t row,
                                std::uint32_t partner, view::PartnerSums& out) {
  using std::abs;
  const double factor = static_cast<double>(view::contact_factor(state));
  const Vec3<Real> partner_center = view::position(state, balance.center_rows[partner]);
  for_each_link(links, row, [&](const view::Link<Real>& link, std::uint32_t role) {
    Real weight = 0;
    Vec3<Real> arm = Vec3<Real>::Zero();
    for (std::uint32_t other = 0; other < 4; ++other) {
      if (link.weight[other] == 0 || balance.row_body[link.rows[other]] != partner) continue;
      weight += link.weight[other];
      arm += (view::position(state, link.rows[other]) - partner_center) * link.weight[other];
    }
    if (!(abs(weight) > Real(1e-3))) return;  // the link is not between the two
    const Mat3<double> k =
        stiffness_of(link).template cast<double>() * (factor * static_cast<double>(link.weight[role] * weight));
    const Mat3<double> r = cross_matrix<double>((view::position(state, row) - center).template cast<double>());
    const Mat3<double> turned = -k * cross_matrix<double>((arm / weight).template cast<double>());
    const Mat3<double> moment = r * k, moment_turned = r * turned;
    for (int i = 0; i < 9; ++i) {
      out.moved[i] += k(i / 3, i % 3);
      out.moved[9 + i] += moment(i / 3, i % 3);
      out.turned[i] += turned(i / 3, i % 3);
      out.turned[9 + i] += moment_turned(i / 3, i % 3);
    }
  });
}

/// Sums what is missing in the motion of each free body, over a patch.
/// Reads displacement, velocity, start_velocity, contacts, friction, links; writes sums, partner_sums.
template <class Team, class Real>
TM_HOST_DEVICE void measure_balance(Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                                    const view::ContactView<Real>& contact, const view::LinksView<Real>& links,
                                    const view::BalanceView<Real>& balance) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  for (std::uint32_t entry = balance.patch_entries[patch.index]; entry < balance.patch_entries[patch.index + 1];
       ++entry) {
    const std::uint32_t body = balance.entry_body[entry];
    const Vec3<Real> center = view::position(state, balance.center_rows[body]);
    Balance own;
    team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
      if (balance.row_body[row] == body) add_row(state, balance, center, row, own);
    });
    if (contact.tool_count > 0) {
      for_each_triangle(team, contact, [&](std::uint32_t triangle) {
        if (balance.row_body[TriangleRows<Real>(contact, triangle).rows[0]] != body) return;
        for (std::uint32_t t = 0; t < contact.tool_count; ++t) {
          const physics::PlacedTool<Real>& tool = contact.tools[t];
          for (std::uint32_t point = 0; point < tool.contact_points; ++point) {
            add_contact(state, contact, center, contact_place(contact, tool, point, triangle), triangle, tool.friction,
                        own);
          }
        }
      });
    }
    if (links.count() > 0) {
      team.for_each(links.patch_rows[patch.index], links.patch_rows[patch.index + 1], [&](std::uint32_t i) {
        if (balance.row_body[links.rows[i]] == body) add_links(state, links, balance, center, links.rows[i], own);
      });
    }
    view::BalanceSums& sums = own.sums();
    team.patch_sum(sums.defect);
    team.patch_sum(sums.sliding);
    team.patch_sum(sums.stiffness);
    team.patch_sum(sums.along_slip);
    if (team.leads_patch()) balance.sums[entry] = sums;
    if (balance.entry_partners == nullptr) continue;
    for (std::uint32_t i = 0; i < balance.entry_partners[entry + 1] - balance.entry_partners[entry]; ++i) {
      const std::uint32_t partner = balance.partners[balance.partner_begin[body] + i];
      view::PartnerSums of_partner{};
      team.for_each(links.patch_rows[patch.index], links.patch_rows[patch.index + 1], [&](std::uint32_t place) {
        const std::uint32_t row = links.rows[place];
        if (balance.row_body[row] == body) add_partner(state, links, balance, center, row, partner, of_partner);
      });
      team.patch_sum(of_partner.moved);
      team.patch_sum(of_partner.turned);
      if (team.leads_patch()) balance.partner_sums[balance.entry_partners[entry] + i] = of_partner;
    }
  }
}

/// Solves S c = d by S = L Lᵀ. Returns whether S is positive definite. triangle: the upper one of S
TM_HOST_DEVICE inline bool solve_rigid(const double (&triangle)[view::kBalanceTriangle], const double (&d)[6],
                                       double (&c)[6]) {
  using std::sqrt;
  double l[6][6];
  std::size_t place = 0;
  for (int column = 0; column < 6; ++column) {
    for (int row = column; row < 6; ++row, ++place) {
      double sum = triangle[place];
      for (int i = 0; i < column; ++i) sum -= l[row][i] * l[column][i];
      if (row == column) {
        if (!(sum > 0)) return false;
        l[row][row] = sqrt(sum);
      } else {
        l[row][column] = sum / l[column][column];
      }
    }
  }
  for (int row = 0; row < 6; ++row) {
    double sum = d[row];
    for (int i = 0; i < row; ++i) sum -= l[row][i] * c[i];
    c[row] = sum / l[row][row];
  }
  for (int row = 5; row >= 0; --row) {
    double sum = c[row];
    for (int i = row + 1; i < 6; ++i) sum -= l[i][row] * c[i];
    c[row] = sum / l[row][row];
  }
  return true;
}

/// Returns whether a correction would reverse the slip of the contacts of a body that slide. h: motion at the end of
/// the step over the velocity that makes it.
TM_HOST_DEVICE inline bool reverses_slip(const view::BalanceSums& total, const double (&c)[6], double h) {
  const double pressure = total.sliding[view::kSlidingN];
  if (!(pressure > 0)) return false;
  const auto mean = [&](std::size_t first) -> Vec3<double> {
    return Vec3<double>(total.sliding[first], total.sliding[first + 1], total.sliding[first + 2]) / pressure;
  };
  const Vec3<double> slip = mean(view::kSlidingSlip), spin(c[3], c[4], c[5]);
  const Vec3<double> motion =
      (Vec3<double>(c[0], c[1], c[2]) + physics::cross<double>(spin, mean(view::kSlidingArm))) * h;
  return motion.dot(slip) > slip.dot(slip);
}

template <class Real>
TM_HOST_DEVICE void set_motion(view::BodyCorrection<Real>& to, const double (&c)[6]) {
  for (int i = 0; i < 3; ++i) {
    to.velocity[i] = static_cast<Real>(c[i]);
    to.spin[i] = static_cast<Real>(c[3 + i]);
  }
}

/// Finds the correction of a free body without partners. h: as for reverses_slip.
template <class Real>
TM_HOST_DEVICE view::BodyCorrection<Real> correction_by(const view::BalanceSums& total, double h) {
  double c[6] = {0, 0, 0, 0, 0, 0};
  view::BodyCorrection<Real> out{};
  if (!solve_rigid(total.stiffness, total.defect, c)) return out;
  if (reverses_slip(total, c, h)) {
    double stiffness[view::kBalanceTriangle];
    for (std::size_t i = 0; i < view::kBalanceTriangle; ++i) stiffness[i] = total.stiffness[i] + total.along_slip[i];
    solve_rigid(stiffness, total.defect, c);
    out.with_along = 1;
  }
  set_motion(out, c);
  return out;
}

/// Returns the part of the system that couples the motion i of a body with the motion j of another, or of itself.
template <class Real>
TM_HOST_DEVICE double coupling_of(const view::BalanceView<Real>& balance, std::uint32_t body, std::uint32_t i,
                                  std::uint32_t other, std::uint32_t j) {
  if (body == other) {
    const std::uint32_t row = i < j ? i : j, column = i < j ? j : i;
    const std::uint32_t place = row * 6 - row * (row + 1) / 2 + column;  // in the upper triangle
    const view::BalanceSums& total = balance.totals[body];
    return total.stiffness[place] + (balance.corrections[body].with_along != 0 ? total.along_slip[place] : 0.0);
  }
  double sum = 0;
  const std::uint32_t first = balance.partner_begin[body];
  for (std::uint32_t partner = first; partner < balance.partner_begin[body + 1]; ++partner) {
    if (balance.partners[partner] != other) continue;
    for (std::uint32_t at = balance.body_begin[body]; at < balance.body_begin[body + 1]; ++at) {
      const view::PartnerSums& of =
          balance.partner_sums[balance.entry_partners[balance.body_entries[at]] + partner - first];
      sum += j < 3 ? of.moved[3 * i + j] : of.turned[3 * i + j - 3];
    }
  }
  return sum;
}

/// Solves for the motions of all free bodies at once, by S = L Lᵀ in one patch. Bodies stay where they are if S is not
/// positive definite. Reads totals, partner_sums, corrections; writes system, motions.
template <class Team, class Real>
TM_HOST_DEVICE void solve_coupled(const Team& team, const view::BalanceView<Real>& balance) {
  using std::sqrt;
  const std::uint32_t n = 6 * balance.body_count;
  double* const s = balance.system;
  team.for_each(0, n * n, [&](std::uint32_t i) {
    const std::uint32_t row = i / n, column = i % n;
    if (column <= row) s[i] = coupling_of(balance, row / 6, row % 6, column / 6, column % 6);
  });
  team.for_each(0, n, [&](std::uint32_t i) { balance.motions[i] = balance.totals[i / 6].defect[i % 6]; });
  team.sync();
  for (std::uint32_t k = 0; k < n; ++k) {
    const double pivot = s[k * n + k];
    team.sync();
    if (!(pivot > 0)) {
      team.for_each(0, n, [&](std::uint32_t i) { balance.motions[i] = 0; });
      team.sync();
      return;
    }
    const double inverse = 1 / sqrt(pivot);
    team.for_each(k, n, [&](std::uint32_t i) { s[i * n + k] *= inverse; });
    team.sync();
    const std::uint32_t left = n - k - 1;
    team.for_each(0, left * left, [&](std::uint32_t i) {
      const std::uint32_t row = k + 1 + i / left, column = k + 1 + i % left;
      if (column <= row) s[row * n + column] -= s[row * n + k] * s[column * n + k];
    });
    team.sync();
  }
  if (team.leads_patch()) {
    double* const c = balance.motions;
    for (std::uint32_t row = 0; row < n; ++row) {
      for (std::uint32_t i = 0; i < row; ++i) c[row] -= s[row * n + i] * c[i];
      c[row] /= s[row * n + row];
    }
    for (std::uint32_t row = n; row-- > 0;) {
      for (std::uint32_t i = row + 1; i < n; ++i) c[row] -= s[i * n + row] * c[i];
      c[row] /= s[row * n + row];
    }
  }
  team.sync();
}

/// Finds the corrections of bodies that have partners, from the totals of all.
template <class Team, class Real>
TM_HOST_DEVICE void correct_coupled(const Team& team, const view::BalanceView<Real>& balance, double h) {
  const auto motion_of = [&](std::uint32_t body, double(&c)[6]) {
    for (std::uint32_t i = 0; i < 6; ++i) c[i] = balance.motions[6 * body + i];
  };
  team.for_each(0, balance.body_count, [&](std::uint32_t body) { balance.corrections[body].with_along = 0; });
  team.sync();
  solve_coupled(team, balance);
  team.for_each(0, balance.body_count, [&](std::uint32_t body) {
    double c[6];
    motion_of(body, c);
    balance.corrections[body].with_along = reverses_slip(balance.totals[body], c, h) ? Real(1) : Real(0);
  });
  team.sync();
  bool any = false;
  for (std::uint32_t body = 0; body < balance.body_count; ++body) any |= balance.corrections[body].with_along != 0;
  if (any) solve_coupled(team, balance);
  team.for_each(0, balance.body_count, [&](std::uint32_t body) {
    double c[6];
    motion_of(body, c);
    set_motion(balance.corrections[body], c);
  });
  team.sync();
}

/// Adds the sums of the patches and finds the correction of each free body. Bodies are shared out among patches, unless
/// some have partners.
/// Reads sums, partner_sums, displacement; writes totals, corrections, reports, system, motions.
template <class Team, class Real>
TM_HOST_DEVICE void solve_balance(const Team& team, const view::PatchesView& patches,
                                  const view::StateView<Real>& state, const view::BalanceView<Real>& balance) {
  using std::sqrt;
  const bool is_coupled = balance.entry_partners != nullptr;
  if (is_coupled && team.patch() != 0) return;
  const double h = static_cast<double>(view::step_size(state) * state.control->scheme.reach);
  const std::uint32_t stride = is_coupled ? 1 : patches.patch_count;
  for (std::uint32_t body = team.patch(); body < balance.body_count; body += stride) {
    double* total = reinterpret_cast<double*>(balance.totals + body);
    team.for_each(0, static_cast<std::uint32_t>(view::kBalanceSums), [&](std::uint32_t i) {
      double sum = 0;
      for (std::uint32_t at = balance.body_begin[body]; at < balance.body_begin[body + 1]; ++at) {
        sum += reinterpret_cast<const double*>(balance.sums + balance.body_entries[at])[i];
      }
      total[i] = sum;
    });
  }
  team.sync();
  if (is_coupled) correct_coupled(team, balance, h);
  if (!team.leads_patch()) return;
  for (std::uint32_t body = team.patch(); body < balance.body_count; body += stride) {
    const view::BalanceSums& sums = balance.totals[body];
    view::BodyCorrection<Real>& correction = balance.corrections[body];
    if (!is_coupled) correction = correction_by<Real>(sums, h);
    const Vec3<Real> center = view::position(state, balance.center_rows[body]);
    for (int c = 0; c < 3; ++c) correction.center_m[c] = center[c];
    double squared = 0;
    for (int c = 0; c < 3; ++c) squared += sums.defect[c] * sums.defect[c];
    balance.reports[body] = {static_cast<Real>(sqrt(squared)), static_cast<Real>(sums.sliding[view::kSizeOfImpulses])};
  }
}

/// Returns w + ω × r.
template <class Real>
TM_HOST_DEVICE Vec3<Real> velocity_at(const view::BodyCorrection<Real>& correction, const Vec3<Real>& r) {
  const Vec3<Real> velocity(correction.velocity[0], correction.velocity[1], correction.velocity[2]);
  return velocity + physics::cross<Real>({correction.spin[0], correction.spin[1], correction.spin[2]}, r);
}

/// Returns how far a correction has moved a point of its body that is now at x [m].
template <class Real>
TM_HOST_DEVICE Vec3<Real> moved_by(const view::BodyCorrection<Real>& correction, const Vec3<Real>& x, Real h) {
  const Vec3<Real> center(correction.center_m[0], correction.center_m[1], correction.center_m[2]);
  const Vec3<Real> velocity(correction.velocity[0], correction.velocity[1], correction.velocity[2]);
  const Vec3<Real> turn = Vec3<Real>(correction.spin[0], correction.spin[1], correction.spin[2]) * h;
  // x = center + r + h w + turn × r, solved for r.
  const Vec3<Real> y = x - center - velocity * h;
  const Vec3<Real> r = (y + turn * turn.dot(y) - physics::cross<Real>(turn, y)) / (1 + turn.dot(turn));
  return velocity_at(correction, r) * h;
}

/// Returns the friction that a contact of a free body has received, after the correction [N].
///
///   stretch, pressure   ξ and N at the end of the step
///   x                   the contact point there
template <class Real>
TM_HOST_DEVICE Vec3<Real> balanced_friction(const ContactPoint<Real>& at, const view::BodyCorrection<Real>& correction,
                                            Real friction, const Vec3<Real>& stretch, Real pressure,
                                            const Vec3<Real>& x) {
  const Vec3<Real> moved = moved_by(correction, x, view::step_size(at.state)) * at.state.control->scheme.reach;
  const Real before = pressure + at.touch.stiffness * at.normal().dot(moved);
  const Vec3<Real> across = at.tangential(moved);
  return coulomb_force<Real>(at.touch.stiffness, friction, stretch + across, before)
      .after(across, correction.with_along != 0);
}

}  // namespace tensormass::contact
