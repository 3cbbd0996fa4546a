// Robocentric Inverse Scaling by hand: the EKF of one pinhole camera with a velocity, for the plane
// (N = 2) and for space (N = 3), with analytic Jacobians of which only the blocks are multiplied.
//
// State: T_CB (t numbers), velocity (t), this step's acceleration (t), M landmarks (N + 1 each). The
// calibration's error is drawn anew in every frame: it is in S only. M is Eigen::Dynamic, or a
// number of landmarks that the compiler is told.

#include <Eigen/Dense>
#include <cmath>
#include <thread>
#include <vector>

using namespace Eigen;

namespace {

template <int N> constexpr int kTangent = N == 2 ? 3 : 6;
template <int N> using Tangent = Matrix<double, kTangent<N>, 1>;
template <int N> using Square = Matrix<double, kTangent<N>, kTangent<N>>;
template <int N> using Vec = Matrix<double, N, 1>;
template <int N> using Mat = Matrix<double, N, N>;
template <int N> using Moved = Matrix<double, N, kTangent<N>>;

Matrix3d hat(const Vector3d& w) {
  Matrix3d W;
  W << 0, -w[2], w[1], w[2], 0, -w[0], -w[1], w[0], 0;
  return W;
}

template <int N> struct Pose {
  Mat<N> R;
  Vec<N> t;
  Pose inverse() const { return {R.transpose(), -R.transpose() * t}; }
  Pose operator*(const Pose& other) const { return {R * other.R, R * other.t + t}; }
};

// ad(xi), of which the right Jacobian is a power series.
Matrix3d ad(const Tangent<2>& xi) {
  Matrix3d A;
  A << 0, -xi[2], xi[1], xi[2], 0, -xi[0], 0, 0, 0;
  return A;
}

Square<3> ad(const Tangent<3>& xi) {
  Square<3> A = Square<3>::Zero();
  A.topLeftCorner<3, 3>() = A.bottomRightCorner<3, 3>() = hat(xi.tail<3>());
  A.topRightCorner<3, 3>() = hat(xi.head<3>());
  return A;
}

// J of Exp(xi + d) = Exp(xi) Exp(J d), and of the left for -xi: sum of (-ad)^k / (k + 1)!.
template <int N> Square<N> right_jacobian(const Tangent<N>& xi) {
  const Square<N> A = ad(xi);
  Square<N> J = Square<N>::Identity();
  for (int k = 12; k > 0; --k) J = Square<N>::Identity() - A * J / (k + 1);
  return J;
}

Matrix3d adjoint(const Pose<2>& T) {
  Matrix3d A = Matrix3d::Identity();
  A.topLeftCorner<2, 2>() = T.R;
  A.topRightCorner<2, 1>() << T.t[1], -T.t[0];
  return A;
}

Square<3> adjoint(const Pose<3>& T) {
  Square<3> A = Square<3>::Zero();
  A.topLeftCorner<3, 3>() = A.bottomRightCorner<3, 3>() = T.R;
  A.topRightCorner<3, 3>() = hat(T.t) * T.R;
  return A;
}

Pose<2> exp(const Tangent<2>& xi) {
  const double a = xi[2], c = std::cos(a), s = std::sin(a);
  const double p = std::abs(a) < 1e-4 ? 1 - a * a / 6 : s / a;
  const double q = std::abs(a) < 1e-4 ? a / 2 : (1 - c) / a;
  return {(Matrix2d() << c, -s, s, c).finished(),
          {p * xi[0] - q * xi[1], q * xi[0] + p * xi[1]}};
}

Pose<3> exp(const Tangent<3>& xi) {
  const Vector3d v = xi.head<3>(), w = xi.tail<3>();
  const double a = w.norm();
  const bool small = a < 1e-3;
  const double A = small ? 1 - a * a / 6 : std::sin(a) / a;
  const double B = small ? 0.5 - a * a / 24 : 2 * std::pow(std::sin(a / 2) / a, 2);
  const double C = small ? 1.0 / 6 - a * a / 120 : (1 - A) / (a * a);
  const Matrix3d W = hat(w), WW = W * W;
  return {Matrix3d::Identity() + A * W + B * WW, v + B * (W * v) + C * (WW * v)};
}

Tangent<2> log(const Pose<2>& T) {
  const double a = std::atan2(T.R(1, 0), T.R(0, 0)), h = a / 2;
  const double k = std::abs(h) < 1e-4 ? 1 - h * h / 3 : h / std::tan(h);
  return {k * T.t[0] + h * T.t[1], -h * T.t[0] + k * T.t[1], a};
}

Tangent<3> log(const Pose<3>& T) {
  const Quaterniond q(T.R);
  const double sign = q.w() < 0 ? -1 : 1, s = q.vec().norm();
  const double a = 2 * std::atan2(s, sign * q.w());
  const Vector3d w = sign * (s < 1e-8 ? 2.0 : a / s) * q.vec();
  const double k = a < 1e-2 ? 1.0 / 12 + a * a / 720
                            : (1 - a / 2 / std::tan(a / 2)) / (a * a);
  Tangent<3> xi;
  xi << T.t - w.cross(T.t) / 2 + k * w.cross(w.cross(T.t)), w;
  return xi;
}

// Derivative of Exp(-d) X for a homogeneous point (X, omega).
Moved<2> moved(const Vector2d& X, double omega) {
  return (Moved<2>() << -omega, 0, X[1], 0, -omega, -X[0]).finished();
}

Moved<3> moved(const Vector3d& X, double omega) {
  Moved<3> J;
  J << -omega * Matrix3d::Identity(), hat(X);
  return J;
}

template <int N> Pose<N> pose_at(const double* matrix) {
  const Map<const Matrix<double, N + 1, N + 1, RowMajor>> T(matrix);
  return {T.template topLeftCorner<N, N>(), T.template topRightCorner<N, 1>()};
}

struct Problem {
  int runs, steps, landmarks;
  double dt, focal[2], centre[2], pixel_sigma;
  const double *acceleration_sigma, *calibration_sigma;  // calibration: null where it is known
  const double *pose, *velocity, *points, *covariance;   // after frame 0, by run
  const double *pixels, *truth;                          // by run and step
  double *nees, *last_covariance;
};

template <int N, int M> struct Filter {
  static constexpr int t = kTangent<N>, d = N + 1, p = N - 1;
  static constexpr int kState = M == Dynamic ? Dynamic : 3 * t + M * d;
  static constexpr int kMeasured = M == Dynamic ? Dynamic : M * p;
  using Rows = Matrix<double, kMeasured, kState, RowMajor>;
  using Cov = Matrix<double, kState, kState, RowMajor>;
  using View = Matrix<double, t, kState, RowMajor>;
  using Seen = Matrix<double, kMeasured, kMeasured>;
  using Pixels = Matrix<double, kMeasured, 1>;

  const Problem& data;
  const int m, n, mp;
  Pose<N> T;
  Tangent<N> v, a;
  std::vector<Matrix<double, d, 1>, aligned_allocator<Matrix<double, d, 1>>> x;
  Cov P, turned;
  Rows HP;
  Seen S;
  View D;
  Pixels residual;
  Matrix<double, kMeasured, t, RowMajor> by_velocity;
  Matrix<double, kMeasured, d, RowMajor> by_landmark;

  explicit Filter(const Problem& data)
      : data(data), m(data.landmarks), n(3 * t + m * d), mp(m * p), x(m), P(n, n), turned(n, n),
        HP(mp, n), S(mp, mp), D(t, n), residual(mp), by_velocity(mp, t), by_landmark(mp, d) {}

  int at(int j) const { return 3 * t + j * d; }

  void start(int run) {
    T = pose_at<N>(data.pose + run * d * d);
    v = Map<const Tangent<N>>(data.velocity + run * t);
    for (int j = 0; j < m; ++j)
      x[j] = Map<const Matrix<double, d, 1>>(data.points + (run * m + j) * d);
    P = Map<const Cov>(data.covariance + size_t(run) * n * n, n, n);
  }

  void measure(const double* pixels) {
    const double dt = data.dt;
    const Pose<N> seen_from = exp(Tangent<N>(v * dt)).inverse();
    const Square<N> step = right_jacobian<N>(v * dt) * dt;
    S.setZero();
    for (int j = 0; j < m; ++j) {
      const Vec<N> X = seen_from.R * x[j].template head<N>() + x[j][N] * seen_from.t;
      const double z = X[N - 1];
      Matrix<double, p, N> by_point = Matrix<double, p, N>::Zero();
      for (int i = 0; i < p; ++i) {
        const double ratio = X[i] / z;
        by_point(i, i) = data.focal[i] / z;
        by_point(i, N - 1) = -data.focal[i] * ratio / z;
        residual[j * p + i] = pixels[j * p + i] - data.focal[i] * ratio - data.centre[i];
        S(j * p + i, j * p + i) = data.pixel_sigma * data.pixel_sigma;
      }
      by_velocity.template middleRows<p>(j * p) = by_point * moved(X, x[j][N]) * step;
      by_landmark.template block<p, N>(j * p, 0) = by_point * seen_from.R;
      by_landmark.template block<p, 1>(j * p, N) = by_point * seen_from.t;
      if (data.calibration_sigma) add_calibration(j, X);
    }
  }

  // The same error of the calibration is in every measurement: f and c of each coordinate.
  void add_calibration(int j, const Vec<N>& X) {
    ratios.resize(mp);
    for (int i = 0; i < p; ++i) ratios[j * p + i] = X[i] / X[N - 1];
    for (int k = 0; k <= j; ++k)
      for (int i = 0; i < p; ++i) {
        const double f = data.calibration_sigma[i], c = data.calibration_sigma[p + i];
        const double both = f * f * ratios[j * p + i] * ratios[k * p + i] + c * c;
        S(j * p + i, k * p + i) += both;
        if (k < j) S(k * p + i, j * p + i) += both;
      }
  }
  std::vector<double> ratios;

  void update(const double* pixels) {
    const double dt = data.dt;
    const Tangent<N> Q = Map<const Tangent<N>>(data.acceleration_sigma).array().square();
    P.template middleRows<t>(2 * t).setZero();
    P.template middleCols<t>(2 * t).setZero();
    P.template block<t, t>(2 * t, 2 * t).diagonal() = Q;
    measure(pixels);
    HP.noalias() = by_velocity * P.template middleRows<t>(t);
    HP.template middleCols<t>(2 * t) += dt * by_velocity * Q.asDiagonal();
    for (int j = 0; j < m; ++j)
      HP.template middleRows<p>(j * p).noalias() +=
          by_landmark.template middleRows<p>(j * p) * P.template middleRows<d>(at(j));
    S.noalias() += HP.template middleCols<t>(t) * by_velocity.transpose();
    S.noalias() += dt * HP.template middleCols<t>(2 * t) * by_velocity.transpose();
    for (int j = 0; j < m; ++j)
      S.template middleCols<p>(j * p).noalias() +=
          HP.template middleCols<d>(at(j)) * by_landmark.template middleRows<p>(j * p).transpose();
    const LLT<Ref<Seen>> factor(S);
    factor.matrixL().solveInPlace(HP);
    factor.matrixL().solveInPlace(residual);
    const Matrix<double, kState, 1> delta = HP.transpose() * residual;
    P.template selfadjointView<Lower>().rankUpdate(HP.transpose(), -1.0);
    P.template triangularView<StrictlyUpper>() = P.transpose();
    T = T * exp(Tangent<N>(delta.template head<t>()));
    v += delta.template segment<t>(t);
    a = delta.template segment<t>(2 * t);
    for (int j = 0; j < m; ++j) x[j] += delta.template segment<d>(at(j));
  }

  // J B, row block by row block, for the composition's Jacobian J.
  template <class B>
  void rows(const B& before, const Pose<N>& back, const Square<N>& step, const Square<N>& Ad,
            Cov& after) {
    const double dt = data.dt;
    after.template middleRows<t>(t) =
        before.template middleRows<t>(t) + dt * before.template middleRows<t>(2 * t);
    D.noalias() = step * after.template middleRows<t>(t);
    after.template middleRows<t>(0) = before.template middleRows<t>(0);
    after.template middleRows<t>(0).noalias() -= Ad * D;
    for (int j = 0; j < m; ++j) {
      auto block = after.template middleRows<N>(at(j));
      block.noalias() = back.R * before.template middleRows<N>(at(j));
      block.noalias() += back.t * before.row(at(j) + N);
      block.noalias() += moved(Vec<N>(x[j].template head<N>()), x[j][N]) * D;
      after.row(at(j) + N) = before.row(at(j) + N);
    }
  }

  void compose() {
    const double dt = data.dt;
    const Tangent<N> xi = (v + a * dt) * dt;
    const Pose<N> back = exp(xi).inverse();
    const Square<N> step = right_jacobian<N>(xi) * dt;
    T = back * T;
    const Square<N> Ad = adjoint(T.inverse());
    v += a * dt;
    for (int j = 0; j < m; ++j)
      x[j].template head<N>() = back.R * x[j].template head<N>() + x[j][N] * back.t;
    // What is left of the acceleration is not read.
    turned.template middleRows<t>(2 * t).setZero();
    rows(P, back, step, Ad, turned);
    turned.transposeInPlace();
    rows(turned, back, step, Ad, P);
  }

  double nees(const Pose<N>& truth) const {
    const Tangent<N> error = log(T.inverse() * truth);
    const Square<N> pose = P.template topLeftCorner<t, t>();
    return error.dot(pose.llt().solve(error));
  }

  void run(int index) {
    start(index);
    for (int k = 0; k < data.steps; ++k) {
      const size_t frame = size_t(index) * data.steps + k;
      update(data.pixels + frame * mp);
      compose();
      data.nees[frame] = nees(pose_at<N>(data.truth + frame * d * d));
    }
    Map<Cov>(data.last_covariance + size_t(index) * n * n, n, n) = P;
  }
};

template <int N, int M> void runs(const Problem& data, int threads) {
  std::vector<std::thread> pool;
  const auto part = [&](int first) {
    Filter<N, M> filter(data);
    for (int i = first; i < data.runs; i += threads) filter.run(i);
  };
  for (int k = 1; k < threads; ++k) pool.emplace_back(part, k);
  part(0);
  for (auto& thread : pool) thread.join();
}

}  // namespace

// `fixed`: with sizes that the compiler knows, for 12 landmarks of the plane.
extern "C" void ekf(const Problem* data, int point_dim, int threads, int fixed) {
  if (point_dim == 3) return runs<3, Dynamic>(*data, threads);
  if (fixed && data->landmarks == 12) return runs<2, 12>(*data, threads);
  runs<2, Dynamic>(*data, threads);
}
