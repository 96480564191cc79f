// The covariance of a registered pose from the sums of its patches, see register/covariance.py.
#pragma once
#include <array>
#include <cstdint>
#include <vector>

#include "symmetric.hpp"

namespace avs {

constexpr int SURFACE = 7;                    // amplitudes of errors of the surface: six of a strain and the offset
constexpr int RANGES = 10;                    // modes of an error of the ranges: a polynomial of third degree over the image
constexpr int AMPLITUDES = SURFACE + RANGES;  // of all
using Six = Square<6>;
using Coupling = std::array<std::array<double, AMPLITUDES>, 6>;

// The pseudo-inverse N^+ of an information N, and W with W W' = N^+.
struct Inverted {
  Six inverse, root;
};
Inverted inverted(Six N);

// Sums of m patches as in `PatchSums`, matrices complete and row by row.
struct PatchTable {
  int64_t m;
  const double *normals, *gradients, *offsets, *errors, *places;
  const int64_t* counts;
  double centre[3];     // about which the strain is taken
  double extent, side;  // of the model, and of a patch [m]
  double camera[3];     // where the rays begin; NaN where that is not known, and errors of the ranges are not fitted

  // What follows from these, see `complete`.
  Inverted total;                       // of the sum of the normals
  std::vector<Coupling> coupling = {};  // of each patch, sums of J times the residual per amplitude
  std::vector<std::array<std::array<double, RANGES>, 3>> ranges = {};  // displacement of a patch per amplitude of the modes
  std::vector<int64_t> block = {};  // the number of the block of each patch, in the order of the blocks' places
  int64_t blocks = 0;
};

// Fills in what follows from the sums; `total` of the sum of their normals.
void complete(PatchTable& patches, const Inverted& total);

struct Systematic {
  double block = 0, smooth[AMPLITUDES] = {}, amplitudes[AMPLITUDES] = {}, fit[6] = {};
};

// Clears in `keep` the patches that give too much of the information on some motion of the patches kept, again until there
// is none. Stops, with `keep` as it was, where too few points would be left. `all`: of the sum of all normals.
void drop_dominant(const double* normals, const int64_t* counts, int64_t m, const Inverted& all, uint8_t* keep);

// A covariance, the degrees of freedom of the estimate, and the part of the covariance from systematic errors.
struct Estimated {
  Six P;
  double dof = 0;
  Six systematic = {};
};

// P = sum over the patches p of m_p m_p', m_p = N^+ ((1 + ALONE) I - N_p N^+)^-1 g_p with N the sum of all N_p.
Estimated sandwich(const double* normals, const double* gradients, int64_t m, const Six& root);

Systematic systematic_errors(const PatchTable& patches);

// Size of the target over that of the model, less 1, fitted with the pose, and its standard error over the patches; 0 and
// infinity where the pose explains any size, as for three faces of a box.
std::array<double, 2> size_error(const PatchTable& patches);

// The gradients (m, 6) without what pose and amplitudes explain.
std::vector<double> unexplained(const PatchTable& patches, const Systematic& errors);

// The sandwich of the gradients `left` that `errors` leave unexplained, and their variances.
Estimated covariance(const PatchTable& patches, const Systematic& errors, const std::vector<double>& left);

// The largest normalised squared difference of the poses of two halves, over the k directions `across` (k, 3); NaN where
// a half does not determine a pose.
double split(const PatchTable& patches, const Systematic& errors, const std::vector<double>& left, const double* across, int64_t k);

// Sum of the normals (m, 6, 6); of the patches kept where `keep` is given.
Six total(const double* normals, int64_t m, const uint8_t* keep = nullptr);
// T: displacement of the middle of a patch per amplitude of the strain.
void strains(const PatchTable& patches, int64_t patch, double (&T)[3][6]);
// A: sums over a patch of J times the residual per amplitude, with T of the same patch.
void couple(const PatchTable& patches, int64_t patch, const double (&T)[3][6], Coupling& A);

}  // namespace avs
