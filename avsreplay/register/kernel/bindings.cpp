// The Python interface: checks shapes, keeps the arrays alive, releases the interpreter lock while it works.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <stdexcept>
#include <utility>

#include "build.hpp"
#include "coarse.hpp"
#include "covariance.hpp"
#include "cubes.hpp"
#include "evidence.hpp"
#include "grade.hpp"
#include "interrupt.hpp"
#include "loop.hpp"
#include "pairs.hpp"
#include "point_tree.hpp"
#include "rays.hpp"
#include "save.hpp"
#include "size.hpp"

namespace nb = nanobind;
using namespace avs;

namespace {

using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Ints = nb::ndarray<const int32_t, nb::c_contig, nb::device::cpu>;
using Bytes = nb::ndarray<const uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Numpy = nb::ndarray<nb::numpy, double>;

unsigned long main_thread;  // the one that handles signals

bool handles_signals() {
  if (PyThread_get_thread_ident() != main_thread) return false;
  nb::gil_scoped_acquire lock;
  if (PyErr_CheckSignals() == 0) return false;
  PyErr_Clear();  // raised again when the work has ended
  return true;
}

void require(bool good, const char* what) {
  if (!good) throw std::invalid_argument(what);
}

// A view of a Python buffer with any strides, also such as are no multiple of a number (packed point records).
class Cloud {
 public:
  explicit Cloud(nb::handle array) {
    if (PyObject_GetBuffer(array.ptr(), &buffer_, PyBUF_RECORDS_RO) != 0) throw nb::python_error();
    const char* format = buffer_.format ? buffer_.format : "B";
    if (*format == '=' || *format == '@') ++format;
    const bool good = buffer_.ndim == 2 && buffer_.shape[1] == 3 && (!std::strcmp(format, "f") || !std::strcmp(format, "d"));
    single_ = *format == 'f';
    if (!good) {
      PyBuffer_Release(&buffer_);
      throw std::invalid_argument("points must be (n, 3), float32 or float64");
    }
  }
  ~Cloud() { PyBuffer_Release(&buffer_); }
  Cloud(const Cloud&) = delete;
  Cloud& operator=(const Cloud&) = delete;

  View view() const {
    return {static_cast<const char*>(buffer_.buf), buffer_.shape[0], buffer_.strides[0], buffer_.strides[1], single_};
  }

 private:
  Py_buffer buffer_;
  bool single_;
};

struct Rows {
  double v[12];
};

Rows rows(const Doubles& T) {
  require(T.ndim() == 2 && T.shape(0) == 4 && T.shape(1) == 4, "a pose must be (4, 4)");
  Rows r;
  std::memcpy(r.v, T.data(), sizeof r.v);
  return r;
}

template <class T>
nb::ndarray<nb::numpy, T> array(std::initializer_list<size_t> shape, T** data) {
  size_t n = 1;
  for (size_t k : shape) n *= k;
  *data = new T[n];
  nb::capsule owner(*data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
  return nb::ndarray<nb::numpy, T>(*data, shape.size(), shape.begin(), owner);
}

template <class T>
nb::ndarray<nb::numpy, T> copied(const std::vector<T>& from, std::initializer_list<size_t> shape) {
  T* to;
  auto out = array<T>(shape, &to);
  std::copy(from.begin(), from.end(), to);
  return out;
}

Numpy matrix(const double* rows34) {
  double* T;
  Numpy out = array<double>({4, 4}, &T);
  std::memcpy(T, rows34, 12 * sizeof(double));
  T[12] = T[13] = T[14] = 0, T[15] = 1;
  return out;
}

Numpy array66(const Six& P) {
  double* out;
  Numpy made = array<double>({6, 6}, &out);
  std::memcpy(out, P.v, sizeof P.v);
  return made;
}

// Every number that is used as an index, and coordinates whose squares single precision can hold.
void check(const Doubles& vertices, const Ints& faces, const Ints& kept) {
  constexpr double largest = 1e15;
  constexpr size_t most = (size_t)1 << 30;
  require(vertices.shape(0) <= most && kept.size() <= most && faces.size() <= 3 * most, "the surface has too many parts");
  for (size_t k = 0; k < vertices.size(); ++k)
    require(std::fabs(vertices.data()[k]) <= largest, "a coordinate is not finite or too large");
  for (size_t k = 0; k < kept.size(); ++k) {
    const int64_t f = kept.data()[k];
    require(f >= 0 && 3 * f + 2 < (int64_t)faces.size(), "a kept face is not there");
    for (int64_t i = 3 * f; i < 3 * f + 3; ++i)
      require(faces.data()[i] >= 0 && faces.data()[i] < (int64_t)vertices.shape(0), "a face refers to a missing vertex");
  }
}

class Index {
 public:
  Index(Doubles vertices, Ints faces, Ints kept, double reach, int threads, bool portable, bool clearances)
      : portable_(portable) {
    require(vertices.ndim() == 2 && vertices.shape(1) == 3 && vertices.shape(0) > 0, "vertices must be (n, 3), n > 0");
    require(reach > 0 && reach < 1e12, "the reach must be positive and finite");
    check(vertices, faces, kept);
    const Surface s{vertices.data(), (int64_t)vertices.shape(0), faces.data(), kept.data(), (int64_t)kept.shape(0)};
    nb::gil_scoped_release release;
    Team team(threads);
    build(store_, s, reach, clearances, code(), team);
  }

  // From what `save` gave; the caller has checked that it is for this model and whole.
  Index(const Bytes& saved, int64_t ids, bool mesh, bool portable) : portable_(portable) {
    const bool sound = restore(reinterpret_cast<const char*>(saved.data()), saved.size(), ids, mesh, store_);
    require(sound, "not a sound index");
  }

  nb::bytes save() const {
    const std::string bytes = avs::save(store_);
    return nb::bytes(bytes.data(), bytes.size());
  }

  nb::tuple closest(nb::handle points, int threads, std::optional<std::array<double, 3>> camera, double most) const {
    require(most > 0, "the largest distance must be positive");
    const Cloud cloud(points);
    const View v = cloud.view();
    const Vec3 eye = camera ? Vec3{(*camera)[0], (*camera)[1], (*camera)[2]} : Vec3{0, 0, 0};
    const bool sided = camera.has_value();
    const double still[12] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0};
    Feet out;
    auto foot = array<double>({(size_t)v.n, 3}, &out.foot), normal = array<double>({(size_t)v.n, 3}, &out.normal);
    auto d2 = array<double>({(size_t)v.n}, &out.d2);
    auto id = array<int32_t>({(size_t)v.n}, &out.id);
    {
      nb::gil_scoped_release release;
      Team team(threads);
      const Code& code = this->code();
      Facing facing;
      code.face(store_, sided ? &eye : nullptr, 0, facing);
      team.each((v.n + CHUNK - 1) / CHUNK, [&](int64_t k) {
        code.closest(store_, v, k * CHUNK, std::min(v.n, (k + 1) * CHUNK), still, facing, sided, std::min(most, store_.reach), out);
      });
    }
    return nb::make_tuple(foot, d2, id, normal);
  }

  nb::tuple icp(nb::handle points, const Doubles& T_ca, int n_max, int n_plane, double gate, double tighten,
                double floor, double eps_rad, double eps_m, int threads, bool keep, bool facing, bool newton,
                int64_t few, int64_t most_work, double poor) const {
    const Cloud cloud(points);
    const View v = cloud.view();
    const Rows T = rows(T_ca);
    require(few == 0 || few >= 6, "a part of the scan must have at least 6 points");
    const Rule rule{n_max, n_plane, few, gate, tighten, floor, eps_rad, eps_m, facing, keep, newton, most_work, poor};
    Outcome o;
    Matches matches;
    {
      nb::gil_scoped_release release;
      Team team(threads);
      o = avs::icp(store_, code(), v, T.v, rule, team, matches);
    }
    const int64_t part = o.few_passes ? (o.few_passes * few + v.n - 1) / v.n : 0;
    return nb::make_tuple(matrix(o.T), o.passes - o.few_passes + part, o.converged, o.inliers, o.rms, o.gate, o.turn, o.move, o.ignored,
                          o.searched, o.work(), matches.kept.empty() ? nb::none() : nb::cast(std::move(matches)));
  }

  nb::tuple normal_equations(nb::handle points, const Doubles& T_ca, double gate, int threads, bool facing) const {
    const Cloud cloud(points);
    const View v = cloud.view();
    const Rows T = rows(T_ca);
    Sums s;
    {
      nb::gil_scoped_release release;
      Team team(threads);
      Facing sides;
      const Vec3 eye{T.v[3], T.v[7], T.v[11]};
      code().face(store_, facing ? &eye : nullptr, 0, sides);
      s = run_pass(store_, code(), v, {T.v, gate, 0.f, Pass::plane, facing, &sides}, nullptr, team);
    }
    double *H, *b;
    auto info = array<double>({6, 6}, &H), gradient = array<double>({6}, &b);
    move_to_origin(s, H, b);
    const int64_t ignored = (int64_t)s.v[2];
    return nb::make_tuple(info, gradient, (int64_t)s.v[0], s.v[34], s.v[1], v.n - ignored, ignored);
  }

  nb::tuple evidence(nb::handle points, const Doubles& T_ca, double gate, double side, int least, bool facing,
                     int threads, const Matches* matches) const {
    require(gate > 0 && side > 0, "gate and patch size must be positive");
    const Cloud cloud(points);
    const View v = cloud.view();
    const Rows T = rows(T_ca);
    Evidence e;
    {
      nb::gil_scoped_release release;
      Team team(threads);
      e = avs::evidence(store_, code(), v, T.v, {gate, side, least, facing}, team, matches);
    }
    double* c;
    auto centre = array<double>({3}, &c);
    std::memcpy(c, e.centre, sizeof e.centre);
    return nb::tuple(nb::make_tuple(e.points, e.inliers, e.sum_d2, e.median, centre) + patches(PatchArrays(e.patches)));
  }

  nb::dict grade(nb::handle points, const Doubles& T_ca, double gate, double side, int least, bool camera, int64_t tested,
                  double least_facing, double extent, double noise, double noise_floor, double least_inliers,
                  double least_ratio, double least_information, bool systematic, double turn, double move,
                  const Doubles& across, double beyond, double least_close, int64_t part,
                  const Doubles& numbers, int64_t many, int64_t least_share, int64_t most_share, int64_t small_share, double quiet,
                  int threads, const Matches* matches) const {
    require(gate > 0 && side > 0 && extent > 0, "gate, patch size and extent must be positive");
    require(tested > 0 && part > 1 && many > 0 && least_share > 0 && most_share >= least_share && small_share > 0, "some points must be tested");
    require(across.ndim() == 2 && across.shape(1) == 3, "directions must be (k, 3)");
    const Cloud cloud(points);
    const View v = cloud.view();
    const Rows T = rows(T_ca);
    const GradeRule rule{{gate, side, least, camera}, extent, tested, least_facing, noise, noise_floor, least_inliers, least_ratio,
                         least_information, systematic, turn, move, {across.data(), across.data() + across.size()},
                         beyond, least_close, part, {{numbers.data(), numbers.data() + numbers.size()}, many, least_share, most_share, small_share, quiet}};
    Grade g;
    {
      nb::gil_scoped_release release;
      Team team(threads);
      g = avs::grade(store_, code(), v, T.v, rule, team, matches);
    }
    double* c;
    auto centre = array<double>({3}, &c);
    std::memcpy(c, g.centre, sizeof g.centre);
    auto bias = array<double>({6}, &c);
    std::copy(g.bias.begin(), g.bias.end(), c);
    auto left = array<double>({6}, &c);
    std::copy(g.left.begin(), g.left.end(), c);
    nb::dict found;  // by the names of quality.PoseQuality
    found["points"] = g.points, found["inliers"] = g.inliers, found["used"] = g.used;
    found["rms_m"] = g.rms, found["noise_m"] = g.noise, found["centre"] = centre;
    found["total"] = array66(g.total), found["statistic"] = g.statistic;
    found["overlap"] = g.overlap, found["observable"] = g.observable;
    found["bounded"] = g.bounded, found["beyond"] = g.beyond;
    found["covariance"] = array66(g.covariance.P), found["systematic"] = array66(g.covariance.systematic);
    found["dof"] = g.covariance.dof, found["split_nis"] = g.split;
    found["size"] = g.size[0], found["size_1s"] = g.size[1];
    found["well_off"] = g.well_off, found["bias"] = bias, found["left"] = left;
    found["chance"] = array66(g.chance), found["patches"] = patches(g.patches);
    return found;
  }

  nb::tuple distances(nb::handle points, const Doubles& T_ca, double most, bool known, int64_t tested, double least_facing) const {
    require(most > 0 && tested > 0, "the largest distance and the number of tested points must be positive");
    const Cloud cloud(points);
    const View v = cloud.view();
    const Rows T = rows(T_ca);
    double* out;
    auto found = array<double>({(size_t)v.n}, &out);
    int64_t work;
    {
      nb::gil_scoped_release release;
      work = avs::distances(store_, code(), v, T.v, {known, tested, least_facing}, most, out);
    }
    return nb::make_tuple(found, work);
  }

  nb::tuple cast(const std::array<double, 3>& eye, const Doubles& directions) const {
    require(store_.mesh && directions.ndim() == 2 && directions.shape(1) == 3, "a mesh, and directions (n, 3)");
    double* out;
    auto found = array<double>({directions.shape(0)}, &out);
    int64_t work;
    {
      nb::gil_scoped_release release;
      work = avs::cast(store_, {eye[0], eye[1], eye[2]}, directions.data(), (int64_t)directions.shape(0), out);
    }
    return nb::make_tuple(found, work);
  }

  nb::object size_step(const Doubles& points, std::optional<std::array<double, 3>> camera, double most, int64_t least, double quantile,
                       double cauchy, double least_information) const {
    require(points.ndim() == 2 && points.shape(1) == 3 && most > 0 && least > 0, "points (n, 3), a distance and a number of points");
    const Vec3 eye = camera ? Vec3{(*camera)[0], (*camera)[1], (*camera)[2]} : Vec3{0, 0, 0};
    SizeStep step;
    {
      nb::gil_scoped_release release;
      const SizeRule rule{most, least, quantile, cauchy, least_information};
      step = avs::size_step(store_, code(), points.data(), (int64_t)points.shape(0), camera ? &eye : nullptr, rule);
    }
    if (!step.found) return nb::none();
    double *d, *c;
    auto pose = array<double>({6}, &d), centre = array<double>({3}, &c);
    std::copy(step.pose, step.pose + 6, d), std::copy(step.centre, step.centre + 3, c);
    return nb::make_tuple(step.size, pose, centre);
  }

  bool faces_camera(nb::handle points, const Doubles& T_ca, int64_t tested, double least_facing) const {
    require(tested > 0, "the number of points must be positive");
    const Cloud cloud(points);
    const View v = cloud.view();
    const Rows T = rows(T_ca);
    nb::gil_scoped_release release;
    return avs::faces_camera(store_, code(), v, T.v, tested, least_facing);
  }

  // Faces with an area, or points.
  int64_t primitives() const {
    int64_t n = (int64_t)LANES * (store_.blocks - 1);
    for (unsigned m = store_.last_valid; m; m &= m - 1) ++n;
    return n;
  }

  size_t bytes() const { return store_.bytes(); }
  const char* isa() const { return code().name; }

  nb::dict shape() const {
    nb::dict d;
    d["blocks"] = store_.blocks;
    d["nodes"] = store_.nodes.size();
    d["grain_m"] = store_.grain;
    d["cell_m"] = store_.cell;
    d["bricks"] = store_.bricks.size() / WORDS;
    d["lists"] = store_.lists.size();
    return d;
  }

 private:
  const Code& code() const { return avs::code(portable_); }

  // Counts, normals, gradients, offsets, errors and places.
  static nb::tuple patches(const PatchArrays& from) {
    const size_t m = from.counts.size();
    return nb::make_tuple(copied(from.counts, {m}), copied(from.normals, {m, 6, 6}), copied(from.gradients, {m, 6}),
                          copied(from.offsets, {m, 6}), copied(from.errors, {m}), copied(from.places, {m, 3}));
  }

  // The sums are about the model's centre c, the answer about {C}'s origin: p x n grows by c x n.
  void move_to_origin(const Sums& s, double* H, double* b) const {
    const double c[3] = {store_.centre.x, store_.centre.y, store_.centre.z};
    const double C[3][3] = {{0, -c[2], c[1]}, {c[2], 0, -c[0]}, {-c[1], c[0], 0}};
    double A[6][6];
    int k = 7;
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j <= i; ++j) A[i][j] = A[j][i] = s.v[k++];
    std::memcpy(b, s.v + 28, 6 * sizeof(double));
    for (int i = 0; i < 3; ++i)
      for (int l = 0; l < 3; ++l) {
        b[i] += C[i][l] * b[3 + l];
        for (int j = 0; j < 6; ++j) A[i][j] += C[i][l] * A[3 + l][j];
      }
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 3; ++j)
        for (int l = 0; l < 3; ++l) A[i][j] += A[i][3 + l] * C[j][l];
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 6; ++j) H[6 * i + j] = i >= j ? A[i][j] : A[j][i];
  }

  Store store_;
  bool portable_;
};

using Patches = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Counts = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

void check_patches(const Patches& normals, const Patches& gradients) {
  require(normals.ndim() == 3 && normals.shape(1) == 6 && normals.shape(2) == 6, "the sums of patches must be (m, 6, 6)");
  require(gradients.ndim() == 2 && gradients.shape(0) == normals.shape(0) && gradients.shape(1) == 6,
          "there must be six sums for each patch");
}

nb::ndarray<nb::numpy, bool> keep_patches(const Patches& normals, const Counts& counts) {
  require(normals.ndim() == 3 && normals.shape(1) == 6 && normals.shape(2) == 6, "the sums of patches must be (m, 6, 6)");
  require(counts.shape(0) == normals.shape(0), "there must be a count for each patch");
  bool* keep;
  auto out = array<bool>({normals.shape(0)}, &keep);
  std::vector<uint8_t> kept(normals.shape(0), 1);
  const int64_t m = (int64_t)kept.size();
  drop_dominant(normals.data(), counts.data(), m, inverted(total(normals.data(), m)), kept.data());
  std::copy(kept.begin(), kept.end(), keep);
  return out;
}

Numpy pseudo_inverse_of(const Patches& N) {
  require(N.ndim() == 2 && N.shape(0) == 6 && N.shape(1) == 6, "the matrix must be (6, 6)");
  Six A;
  std::memcpy(A.v, N.data(), sizeof A.v);
  return array66(pseudo_inverse(A));
}

nb::tuple sandwich_of(const Patches& normals, const Patches& gradients) {
  check_patches(normals, gradients);
  const int64_t m = (int64_t)normals.shape(0);
  const Estimated found = sandwich(normals.data(), gradients.data(), m, inverted(total(normals.data(), m)).root);
  return nb::make_tuple(array66(found.P), found.dof);
}

// The sums of patches, kept alive by the arrays in it.
struct Table {
  Patches normals, gradients, offsets, errors, places;
  Counts counts;
  PatchTable table;

  Table(Patches normals, Patches gradients, Patches offsets, Counts counts, Patches errors, Patches places,
        std::array<double, 3> centre, double extent, double side, std::array<double, 3> camera)
      : normals(normals), gradients(gradients), offsets(offsets), errors(errors), places(places), counts(counts) {
    check_patches(normals, gradients), check_patches(normals, offsets);
    const size_t m = normals.shape(0);
    require(counts.shape(0) == m && errors.ndim() == 1 && errors.shape(0) == m, "there must be a count and an error for each patch");
    require(places.ndim() == 2 && places.shape(0) == m && places.shape(1) == 3, "places must be (m, 3)");
    require(extent > 0 && side > 0, "extent and patch size must be positive");
    table = {(int64_t)m, normals.data(), gradients.data(), offsets.data(), errors.data(), places.data(), counts.data(),
             {centre[0], centre[1], centre[2]}, extent, side, {camera[0], camera[1], camera[2]}, {}};
    complete(table, inverted(total(table.normals, table.m)));
  }
};

using Amplitudes = std::array<double, AMPLITUDES>;

Systematic errors_of(double block, const Amplitudes& smooth, const Amplitudes& amplitudes, const std::array<double, 6>& fit) {
  Systematic e;
  e.block = block;
  std::copy(smooth.begin(), smooth.end(), e.smooth), std::copy(amplitudes.begin(), amplitudes.end(), e.amplitudes);
  std::copy(fit.begin(), fit.end(), e.fit);
  return e;
}

nb::tuple systematic_of(const Table& t) {
  const Systematic e = systematic_errors(t.table);
  double *smooth, *amplitudes, *fit;
  auto a = array<double>({AMPLITUDES}, &smooth), b = array<double>({AMPLITUDES}, &amplitudes), c = array<double>({6}, &fit);
  std::memcpy(smooth, e.smooth, sizeof e.smooth), std::memcpy(amplitudes, e.amplitudes, sizeof e.amplitudes);
  std::memcpy(fit, e.fit, sizeof e.fit);
  return nb::make_tuple(e.block, a, b, c);
}

nb::tuple covariance_of(const Table& t, double block, const Amplitudes& smooth, const Amplitudes& amplitudes, const std::array<double, 6>& fit) {
  const Systematic errors = errors_of(block, smooth, amplitudes, fit);
  const Estimated found = covariance(t.table, errors, unexplained(t.table, errors));
  return nb::make_tuple(array66(found.P), found.dof);
}

double split_of(const Table& t, double block, const Amplitudes& smooth, const Amplitudes& amplitudes, const std::array<double, 6>& fit,
                const Patches& across) {
  require(across.ndim() == 2 && across.shape(1) == 3, "directions must be (k, 3)");
  const Systematic errors = errors_of(block, smooth, amplitudes, fit);
  return split(t.table, errors, unexplained(t.table, errors), across.data(), (int64_t)across.shape(0));
}

using Poses = nb::ndarray<const double, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

Field field_of(const Doubles& points, const Doubles& normals, int across) {
  require(points.ndim() == 2 && points.shape(1) == 3 && points.shape(0) > 0, "points must be (n, 3), n > 0");
  require((int64_t)points.shape(0) <= Field::MOST, "too many points");
  require(normals.ndim() == 2 && normals.shape(0) == points.shape(0) && normals.shape(1) == 3, "a normal for each point");
  require(across > 0 && across <= 256, "cells along the diagonal must be in [1, 256]");
  for (size_t k = 0; k < points.size(); ++k)
    require(std::isfinite(points.data()[k]) && std::isfinite(normals.data()[k]), "a coordinate is not finite");
  return Field(points.data(), normals.data(), (int64_t)points.shape(0), across);
}

nb::tuple refine(const Field& field, const Doubles& points, const Poses& T_ca, int passes, double gate, double fall,
                 double floor, double beyond, bool facing, int threads) {
  require(points.ndim() == 2 && points.shape(1) == 3, "points must be (n, 3)");
  require(T_ca.shape(1) == 4 && T_ca.shape(2) == 4, "poses must be (k, 4, 4)");
  require(beyond > 0 && passes >= 0, "the width must be positive");
  const size_t n = T_ca.shape(0);
  double *T, *cost;
  auto poses = array<double>({n, 4, 4}, &T), costs = array<double>({n}, &cost);
  std::memcpy(T, T_ca.data(), 16 * n * sizeof(double));
  const CoarseRule rule{passes, gate, fall, floor, beyond, facing};
  {
    nb::gil_scoped_release release;
    const CoarseScan scan(points.data(), (int64_t)points.shape(0));
    Team team(threads);
    team.each((int64_t)n, [&](int64_t k) { cost[k] = field.refine(code(false), scan, rule, T + 16 * k); });
  }
  return nb::make_tuple(poses, costs);
}

nb::tuple nearest(const PointTree& tree, const Doubles& points, int64_t k, double most) {
  require(points.ndim() == 2 && points.shape(1) == 3 && k > 0 && k < 100, "points must be (n, 3), and k from 1 to 99");
  const size_t n = points.shape(0);
  double* distance;
  int64_t* number;
  auto distances = array<double>({n, (size_t)k}, &distance);
  auto numbers = array<int64_t>({n, (size_t)k}, &number);
  {
    nb::gil_scoped_release release;
    std::vector<std::pair<double, int64_t>> best(k);
    for (size_t i = 0; i < n; ++i) {
      poll((int64_t)i);
      tree.query(points.data() + 3 * i, k, best.data(), most);
      for (int64_t j = 0; j < k; ++j) {
        number[i * k + j] = best[j].second;
        distance[i * k + j] = best[j].second < tree.size() ? std::sqrt(best[j].first) : HUGE_VAL;
      }
    }
  }
  return nb::make_tuple(distances, numbers);
}

nb::tuple voxels(const Doubles& points, double size) {
  require(points.ndim() == 2 && points.shape(1) == 3, "points must be (n, 3)");
  require(size > 0, "the size of a voxel must be positive");
  const size_t n = points.shape(0);
  int64_t *of, *first, *count;
  auto numbers = array<int64_t>({n}, &of);
  std::vector<int64_t> begin, many;
  {
    nb::gil_scoped_release release;
    Numbers cubes;
    for (size_t k = 0; k < n; ++k) {
      of[k] = cubes.of(cube_of(points.data() + 3 * k, 1 / size));
      if (cubes.size() > begin.size()) begin.push_back((int64_t)k), many.push_back(0);
      ++many[(size_t)of[k]];
    }
  }
  auto firsts = array<int64_t>({begin.size()}, &first), counts = array<int64_t>({begin.size()}, &count);
  std::copy(begin.begin(), begin.end(), first), std::copy(many.begin(), many.end(), count);
  return nb::make_tuple(firsts, numbers, counts);
}

nb::ndarray<nb::numpy, int64_t> different_of(const Poses& T, const std::array<double, 3>& middle, int64_t most, double trace,
                                             double near) {
  require(T.shape(1) == 4 && T.shape(2) == 4, "poses must be (k, 4, 4)");
  const std::vector<int64_t> kept = different(T.data(), (int64_t)T.shape(0), middle.data(), most, trace, near);
  int64_t* out;
  auto numbers = array<int64_t>({kept.size()}, &out);
  std::copy(kept.begin(), kept.end(), out);
  return numbers;
}

using Indices = nb::ndarray<const int64_t, nb::c_contig, nb::device::cpu>;

bool are_vectors(const Doubles& a, size_t n) { return a.ndim() == 2 && a.shape(0) == n && a.shape(1) == 3; }

nb::tuple planes(const PointTree& tree, const Doubles& all, const Doubles& sides, const Doubles& points,
                 const Doubles& normals, int64_t k, double most, double least_cosine) {
  const size_t n = points.shape(0);
  require(are_vectors(all, (size_t)tree.size()) && are_vectors(sides, (size_t)tree.size()) && are_vectors(points, n) &&
          are_vectors(normals, n) && k > 0 && k < 100, "points and normals must be (n, 3), and k from 1 to 99");
  double *direction, *square;
  int64_t* count;
  auto directions = array<double>({n, 3}, &direction);
  auto squares = array<double>({n}, &square);
  auto counts = array<int64_t>({n}, &count);
  {
    nb::gil_scoped_release release;
    std::vector<std::pair<double, int64_t>> best(k);
    for (size_t i = 0; i < n; ++i) {
      poll((int64_t)i);
      tree.query(points.data() + 3 * i, k, best.data(), most);
      const Plane plane = plane_of(best, all.data(), sides.data(), normals.data() + 3 * i, least_cosine, tree.size());
      std::copy(plane.normal, plane.normal + 3, direction + 3 * i);
      square[i] = plane.square, count[i] = plane.count;
    }
  }
  return nb::make_tuple(directions, squares, counts);
}

nb::tuple pair_sums(const Doubles& points, const Doubles& normals, const Doubles& weights, const Indices& from,
                    const Indices& to, const Indices& begin, double gate) {
  const size_t n = points.shape(0), count = begin.size() > 0 ? begin.size() - 1 : 0;
  require(are_vectors(points, n) && are_vectors(normals, n) && weights.size() == n && from.size() == to.size() &&
          begin.size() > 0 && begin.data()[0] == 0 && (size_t)begin.data()[count] == from.size(), "arrays of pairs do not fit");
  for (size_t i = 0; i < from.size(); ++i)
    require(from.data()[i] >= 0 && (size_t)from.data()[i] < n && to.data()[i] >= 0 && (size_t)to.data()[i] < n,
            "a number of a point is out of range");
  for (size_t i = 0; i < count; ++i) require(begin.data()[i] <= begin.data()[i + 1], "pairs must be in order");
  double *normal, *right, *distance, *total;
  auto matrices = array<double>({count, 6, 6}, &normal);
  auto sides = array<double>({count, 6}, &right);
  auto distances = array<double>({from.size()}, &distance);
  auto totals = array<double>({2}, &total);
  {
    nb::gil_scoped_release release;
    total[0] = total[1] = 0;
    for (size_t i = 0; i < count; ++i)
      add_pairs(points.data(), normals.data(), weights.data(), from.data(), to.data(), begin.data()[i], begin.data()[i + 1],
                gate, normal + 36 * i, right + 6 * i, distance, total);
  }
  return nb::make_tuple(matrices, sides, distances, totals);
}

bool is_narrower_at(nb::handle points, const Doubles& T_ca, const Doubles& model, double least) {
  require(are_vectors(model, model.shape(0)), "points of the model must be (n, 3)");
  const Cloud cloud(points);
  const View v = cloud.view();
  const Rows T = rows(T_ca);
  nb::gil_scoped_release release;
  return is_narrower(v, T.v, model.data(), (int64_t)model.shape(0), least);
}

nb::ndarray<nb::numpy, int64_t> seen_at(nb::handle points, const Doubles& T_ca, const Doubles& model, const Doubles& normals,
                                        double in_front, double least_facing, double least_cosine, double hidden, double per_cell) {
  require(are_vectors(model, model.shape(0)) && are_vectors(normals, model.shape(0)), "points of the model and normals must be (n, 3)");
  const Cloud cloud(points);
  const View v = cloud.view();
  const Rows T = rows(T_ca);
  std::vector<int64_t> found;
  {
    nb::gil_scoped_release release;
    found = seen(v, T.v, model.data(), normals.data(), (int64_t)model.shape(0), {in_front, least_facing, least_cosine, hidden, per_cell});
  }
  return copied(found, {found.size()});
}

}  // namespace

NB_MODULE(_kernel, m) {
  keep_freed_memory();
  main_thread = nb::cast<unsigned long>(nb::module_::import_("threading").attr("main_thread")().attr("ident"));
  handle_signals = &handles_signals;
  nb::register_exception_translator([](const std::exception_ptr& p, void*) {
    try {
      std::rethrow_exception(p);
    } catch (const Interrupted&) {
      PyErr_SetNone(PyExc_KeyboardInterrupt);
    }
  });
  m.def("request_stop", [](bool wanted) { stop_requested = wanted; }, nb::arg("wanted"));
  m.def("shield", [](bool wanted) { return std::exchange(shielded, wanted); }, nb::arg("wanted"));
  m.def("is_shielded", [] { return shielded; });
  m.attr("LAYOUT") = LAYOUT;
  m.def("checksum", [](const Bytes& b) { return checksum(reinterpret_cast<const char*>(b.data()), b.size()); }, nb::arg("payload"));
  nb::class_<Matches>(m, "Matches");
  m.def("keep_patches", &keep_patches, nb::arg("normals"), nb::arg("counts"));
  m.def("pseudo_inverse", &pseudo_inverse_of, nb::arg("N"));
  m.def("sandwich", &sandwich_of, nb::arg("normals"), nb::arg("gradients"));
  nb::class_<Table>(m, "Table")
      .def(nb::init<Patches, Patches, Patches, Counts, Patches, Patches, std::array<double, 3>, double, double,
                    std::array<double, 3>>(),
           nb::arg("normals"), nb::arg("gradients"), nb::arg("offsets"), nb::arg("counts"), nb::arg("errors"),
           nb::arg("places"), nb::arg("centre"), nb::arg("extent_m"), nb::arg("side_m"), nb::arg("camera"))
      .def("systematic", &systematic_of)
      .def("size_error", [](const Table& t) { return size_error(t.table); })
      .def("covariance", &covariance_of, nb::arg("block"), nb::arg("smooth"), nb::arg("amplitudes"), nb::arg("fit"))
      .def("split", &split_of, nb::arg("block"), nb::arg("smooth"), nb::arg("amplitudes"), nb::arg("fit"), nb::arg("across"));
  m.def("is_narrower", &is_narrower_at, nb::arg("points"), nb::arg("T_ca"), nb::arg("model"), nb::arg("least"));
  m.def("seen", &seen_at, nb::arg("points"), nb::arg("T_ca"), nb::arg("model"), nb::arg("normals"), nb::arg("in_front"),
        nb::arg("least_facing"), nb::arg("least_cosine"), nb::arg("hidden_m"), nb::arg("per_cell"));
  m.def("pair_sums", &pair_sums, nb::arg("points"), nb::arg("normals"), nb::arg("weights"), nb::arg("from_points"),
        nb::arg("to_points"), nb::arg("begin"), nb::arg("gate_m"));
  nb::class_<PointTree>(m, "PointTree")
      .def("__init__", [](PointTree* tree, const Doubles& points) {
        require(points.ndim() == 2 && points.shape(1) == 3, "points must be (n, 3)");
        nb::gil_scoped_release release;
        new (tree) PointTree(points.data(), (int64_t)points.shape(0)); }, nb::arg("points"))
      .def("query", &nearest, nb::arg("points"), nb::arg("k") = 1, nb::arg("most_m") = HUGE_VAL)
      .def("planes", &planes, nb::arg("all_points"), nb::arg("all_normals"), nb::arg("points"), nb::arg("normals"), nb::arg("k"),
           nb::arg("most_m") = HUGE_VAL, nb::arg("least_cosine") = -2.0)
      .def("groups", [](const PointTree& tree, double most) {
        int64_t* of;
        auto numbers = array<int64_t>({(size_t)tree.size()}, &of);
        nb::gil_scoped_release release;
        const auto found = tree.groups(most);
        std::copy(found.begin(), found.end(), of);
        return numbers; }, nb::arg("most_m"));
  m.def("voxels", &voxels, nb::arg("points"), nb::arg("size_m"));
  m.def("different", &different_of, nb::arg("T_ca"), nb::arg("middle"), nb::arg("most"), nb::arg("trace"), nb::arg("near_m"));
  nb::class_<Field>(m, "Field")
      .def("__init__", [](Field* f, const Doubles& points, const Doubles& normals, int across) {
        new (f) Field(field_of(points, normals, across)); }, nb::arg("points"), nb::arg("normals"), nb::arg("across"))
      .def("refine", &refine, nb::arg("points"), nb::arg("T_ca"), nb::arg("passes"), nb::arg("gate_m"), nb::arg("fall"),
           nb::arg("floor_m"), nb::arg("beyond_m"), nb::arg("facing"), nb::arg("threads") = 1);
  nb::class_<Index>(m, "Index")
      .def(nb::init<Doubles, Ints, Ints, double, int, bool, bool>(), nb::arg("vertices"), nb::arg("faces"),
           nb::arg("kept"), nb::arg("reach_m"), nb::arg("threads") = 1, nb::arg("portable") = false,
           nb::arg("clearances") = true)
      .def(nb::init<Bytes, int64_t, bool, bool>(), nb::arg("saved"), nb::arg("ids"),
           nb::arg("mesh"), nb::arg("portable") = false)
      .def("save", &Index::save)
      .def("closest", &Index::closest, nb::arg("points"), nb::arg("threads") = 1,
           nb::arg("camera_c").none() = nb::none(), nb::arg("most_m") = HUGE_VAL)
      .def("icp", &Index::icp, nb::arg("points"), nb::arg("T_ca"), nb::arg("n_max"), nb::arg("n_plane"),
           nb::arg("gate_m"), nb::arg("tighten"), nb::arg("floor_m"), nb::arg("eps_rad"), nb::arg("eps_m"),
           nb::arg("threads") = 1, nb::arg("keep") = false, nb::arg("facing") = false, nb::arg("newton") = false,
           nb::arg("few") = 0, nb::arg("most_work") = std::numeric_limits<int64_t>::max(), nb::arg("poor_m") = 0.0)
      .def("normal_equations", &Index::normal_equations, nb::arg("points"), nb::arg("T_ca"), nb::arg("gate_m"),
           nb::arg("threads") = 1, nb::arg("facing") = false)
      .def("evidence", &Index::evidence, nb::arg("points"), nb::arg("T_ca"), nb::arg("gate_m"), nb::arg("patch_m"),
           nb::arg("least_patches"), nb::arg("facing") = false, nb::arg("threads") = 1,
           nb::arg("matches").none() = nb::none())
      .def("grade", &Index::grade, nb::arg("points"), nb::arg("T_ca"), nb::kw_only(), nb::arg("gate_m"), nb::arg("patch_m"),
           nb::arg("least_patches"), nb::arg("camera"), nb::arg("tested"), nb::arg("least_facing"), nb::arg("extent_m"),
           nb::arg("noise_m"), nb::arg("noise_floor_m"), nb::arg("least_inliers"), nb::arg("least_ratio"),
           nb::arg("least_information"), nb::arg("systematic"), nb::arg("turn_rad"), nb::arg("move_m"), nb::arg("across"),
           nb::arg("beyond_m"), nb::arg("least_close"), nb::arg("part"), nb::arg("numbers"), nb::arg("many"),
           nb::arg("least_share"), nb::arg("most_share"), nb::arg("small_share"), nb::arg("quiet_m"), nb::arg("threads") = 1,
           nb::arg("matches").none() = nb::none())
      .def("distances", &Index::distances, nb::arg("points"), nb::arg("T_ca"), nb::arg("most_m"), nb::arg("camera"),
           nb::arg("tested"), nb::arg("least_facing"))
      .def("cast", &Index::cast, nb::arg("eye"), nb::arg("directions"))
      .def("size_step", &Index::size_step, nb::arg("points"), nb::arg("camera").none(), nb::arg("most_m"), nb::arg("least"),
           nb::arg("normal_quantile"), nb::arg("cauchy"), nb::arg("least_information"))
      .def("faces_camera", &Index::faces_camera, nb::arg("points"), nb::arg("T_ca"), nb::arg("tested"), nb::arg("least_facing"))
      .def_prop_ro("primitives", &Index::primitives)
      .def_prop_ro("nbytes", &Index::bytes)
      .def_prop_ro("isa", &Index::isa)
      .def_prop_ro("shape", &Index::shape);
}
