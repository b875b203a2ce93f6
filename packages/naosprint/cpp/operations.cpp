#include "operations.hpp"

#include <cmath>

namespace naosprint {

double pairwise_sum(const double* values, std::int64_t count) {
  if (count < 8) {
    double sum = -0.0;
    for (std::int64_t k = 0; k < count; ++k) sum += values[k];
    return sum;
  }
  if (count <= 128) {
    double r[8];
    for (int j = 0; j < 8; ++j) r[j] = values[j];
    std::int64_t k = 8;
    for (; k < count - count % 8; k += 8)
      for (int j = 0; j < 8; ++j) r[j] += values[k + j];
    double sum = ((r[0] + r[1]) + (r[2] + r[3])) + ((r[4] + r[5]) + (r[6] + r[7]));
    for (; k < count; ++k) sum += values[k];
    return sum;
  }
  std::int64_t half = count / 2;
  half -= half % 8;
  return pairwise_sum(values, half) + pairwise_sum(values + half, count - half);
}

namespace {

constexpr double kStepS = 0.02;

// Chosen columns of an array, as value * factor * sign - offset; NaN becomes 0 if `missing` is set.
class Columns : public Operation {
 public:
  explicit Columns(const Arguments& a)
      : source_(a.real("source", 0)), factor_(a.number("factor")), offset_(a.number("offset")), missing_(a.number("missing") != 0.0) {
    const auto &index = a.list("index"), &sign = a.list("sign");
    if (index.size() != sign.size()) throw std::invalid_argument("operation columns: one sign per index is needed");
    for (std::size_t c = 0; c < index.size(); ++c) {
      if (!(index[c] >= 0 && index[c] < source_.width)) throw std::invalid_argument("operation columns: index out of range");
      columns_.push_back({static_cast<int>(index[c]), sign[c]});
    }
  }
  int width() const override { return static_cast<int>(columns_.size()); }
  void measure(const Rows& rows, const Table<double>& out) const override {
    for (int k = 0; k < rows.count; ++k) {
      const double* from = source_[rows[k]];
      double* to = out[rows[k]];
      for (const auto& column : columns_) {
        const double value = from[column.index];
        *to++ = missing_ && value != value ? 0.0 : value * factor_ * column.sign - offset_;
      }
    }
  }

 private:
  struct Column {
    int index;
    double sign;
  };
  Table<double> source_;
  double factor_, offset_;
  bool missing_;
  std::vector<Column> columns_;
};

// Whole numbers.
class Counts : public Operation {
 public:
  explicit Counts(const Arguments& a) : source_(a.integer("source", 0)) {}
  int width() const override { return source_.width; }
  void measure(const Rows& rows, const Table<double>& out) const override {
    for (int k = 0; k < rows.count; ++k)
      for (int c = 0; c < source_.width; ++c) out[rows[k]][c] = static_cast<double>(source_[rows[k]][c]);
  }

 private:
  Table<std::int64_t> source_;
};

// 1 where a flag is set, else 0.
class Flags : public Operation {
 public:
  explicit Flags(const Arguments& a) : source_(a.flag("source", 1)) {}
  int width() const override { return 1; }
  void measure(const Rows& rows, const Table<double>& out) const override {
    for (int k = 0; k < rows.count; ++k) *out[rows[k]] = *source_[rows[k]] ? 1.0 : 0.0;
  }

 private:
  Table<bool> source_;
};

// Angle from the world's +x to the torso's front, from the true rotation or, if given, the perceived quaternion.
class Front {
 public:
  explicit Front(const Arguments& a) : axis_(static_cast<int>(a.number("front"))) {
    if (a.reals.count("quaternion") > 0)
      quaternion_ = a.real("quaternion", 4);
    else
      rotation_ = a.real("rotation", 9);
  }
  double yaw(std::int64_t row) const {
    if (quaternion_.data == nullptr) return std::atan2(rotation_[row][3 + axis_], rotation_[row][axis_]);
    const double *q = quaternion_[row], w = q[0], x = q[1], y = q[2], z = q[3];
    if (axis_ == 0) return std::atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z));
    return std::atan2(1 - 2 * (x * x + z * z), 2 * (x * y - w * z));
  }

 private:
  int axis_;
  Table<double> quaternion_, rotation_;
};

class Yaw : public Operation {
 public:
  explicit Yaw(const Arguments& a) : front_(a) {}
  int width() const override { return 1; }
  void measure(const Rows& rows, const Table<double>& out) const override {
    for (int k = 0; k < rows.count; ++k) *out[rows[k]] = front_.yaw(rows[k]);
  }

 private:
  Front front_;
};

class Heading : public Operation {
 public:
  explicit Heading(const Arguments& a) : front_(a) {}
  int width() const override { return 2; }
  void measure(const Rows& rows, const Table<double>& out) const override {
    for (int k = 0; k < rows.count; ++k) {
      const double yaw = front_.yaw(rows[k]);
      out[rows[k]][0] = std::sin(yaw);
      out[rows[k]][1] = std::cos(yaw);
    }
  }

 private:
  Front front_;
};

// Centre of mass by the robot's own module; see Kinematics in packages/naosim/cpp/batch.hpp.
class CentreOfMass : public Operation {
 public:
  explicit CentreOfMass(const Arguments& a) : angles_(a.real("angles", 0)), kinematics_(reinterpret_cast<const Kinematics*>(a.function)) {
    if (kinematics_ == nullptr) throw std::invalid_argument("operation centre_of_mass: function is missing");
  }
  int width() const override { return 3; }
  void measure(const Rows& rows, const Table<double>& out) const override {
    thread_local std::vector<double> centres;
    centres.resize(3 * static_cast<std::size_t>(rows.count));
    const double* from = rows.index == nullptr ? angles_[rows.first] : angles_.data;
    kinematics_->centre_of_mass(kinematics_->model, from, angles_.stride, rows.index, rows.count, centres.data());
    for (int k = 0; k < rows.count; ++k)
      for (int c = 0; c < 3; ++c) out[rows[k]][c] = centres[3 * static_cast<std::size_t>(k) + c];
  }

 private:
  struct Kinematics {
    const void* model;
    void (*centre_of_mass)(const void* model, const double* angles_deg, std::ptrdiff_t stride, const std::int64_t* rows, int count, double* out);
  };
  Table<double> angles_;
  const Kinematics* kinematics_;
};

// Steps since the right and the left foot last touched down.
class FootCounters : public Operation {
 public:
  explicit FootCounters(const Arguments& a)
      : feet_{a.real("foot_left", 6), a.real("foot_right", 6)}, counters_(a.integer("counters", 2)), loaded_(a.flag("feet_loaded", 2)) {}
  int width() const override { return 2; }
  void begin(const Rows& rows) override {
    for (int k = 0; k < rows.count; ++k)
      for (int side = 0; side < 2; ++side) {
        counters_[rows[k]][side] = 0;
        loaded_[rows[k]][side] = touches(rows[k], side);
      }
  }
  void update(const Rows& rows) override {
    for (int k = 0; k < rows.count; ++k)
      for (int side = 0; side < 2; ++side) {
        const bool now = touches(rows[k], side);
        bool& before = loaded_[rows[k]][side];
        std::int64_t& counter = counters_[rows[k]][side];
        counter = now && !before ? 0 : counter + 1;
        before = now;
      }
  }
  void measure(const Rows& rows, const Table<double>& out) const override {
    for (int k = 0; k < rows.count; ++k)
      for (int side = 0; side < 2; ++side) out[rows[k]][side] = static_cast<double>(counters_[rows[k]][1 - side]);
  }

 private:
  // A comparison with NaN, which stands for no contact, is false.
  bool touches(std::int64_t row, int side) const {
    const double* force = feet_[side][row] + 3;
    return force[0] * force[0] + force[1] * force[1] + force[2] * force[2] > 0.0;
  }
  Table<double> feet_[2];
  Table<std::int64_t> counters_;
  Table<bool> loaded_;
};

// Direction of the world's z axis in the torso's frame, from the perceived quaternion.
class Gravity : public Operation {
 public:
  explicit Gravity(const Arguments& a) : quaternion_(a.real("quaternion", 4)) {}
  int width() const override { return 3; }
  void measure(const Rows& rows, const Table<double>& out) const override {
    for (int k = 0; k < rows.count; ++k) {
      const double *q = quaternion_[rows[k]], w = q[0], x = q[1], y = q[2], z = q[3];
      double* to = out[rows[k]];
      to[0] = 2 * (x * z - w * y);
      to[1] = 2 * (y * z + w * x);
      to[2] = 1 - 2 * (x * x + y * y);
    }
  }

 private:
  Table<double> quaternion_;
};

// Velocity in the torso's frame, from the difference of the last two perceived positions.
class Velocity : public Operation {
 public:
  explicit Velocity(const Arguments& a)
      : position_(a.real("position", 3)), quaternion_(a.real("quaternion", 4)), before_(a.real("before", 3)), velocity_(a.real("velocity", 3)) {}
  int width() const override { return 3; }
  void begin(const Rows& rows) override {
    for (int k = 0; k < rows.count; ++k)
      for (int c = 0; c < 3; ++c) {
        before_[rows[k]][c] = position_[rows[k]][c];
        velocity_[rows[k]][c] = 0.0;
      }
  }
  void update(const Rows& rows) override {
    for (int k = 0; k < rows.count; ++k) {
      const std::int64_t row = rows[k];
      double moved[3];
      for (int c = 0; c < 3; ++c) {
        moved[c] = (position_[row][c] - before_[row][c]) / kStepS;
        before_[row][c] = position_[row][c];
      }
      const double a = moved[0], b = moved[1], c = moved[2], *q = quaternion_[row], w = q[0], x = q[1], y = q[2], z = q[3];
      double* to = velocity_[row];
      to[0] = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c;
      to[1] = 2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c;
      to[2] = 2 * (x * z + w * y) * a + 2 * (y * z - w * x) * b + (1 - 2 * (x * x + y * y)) * c;
    }
  }
  void measure(const Rows& rows, const Table<double>& out) const override {
    for (int k = 0; k < rows.count; ++k)
      for (int c = 0; c < 3; ++c) out[rows[k]][c] = velocity_[rows[k]][c];
  }

 private:
  Table<double> position_, quaternion_, before_, velocity_;
};

// Forward and lateral velocity on the field, from the difference of the last two true positions.
class GroundVelocity : public Operation {
 public:
  explicit GroundVelocity(const Arguments& a) : position_(a.real("position", 3)), before_(a.real("before", 2)), velocity_(a.real("velocity", 2)) {}
  int width() const override { return 2; }
  void begin(const Rows& rows) override {
    for (int k = 0; k < rows.count; ++k)
      for (int c = 0; c < 2; ++c) {
        before_[rows[k]][c] = position_[rows[k]][c];
        velocity_[rows[k]][c] = 0.0;
      }
  }
  void update(const Rows& rows) override {
    for (int k = 0; k < rows.count; ++k)
      for (int c = 0; c < 2; ++c) {
        const double now = position_[rows[k]][c];
        velocity_[rows[k]][c] = (now - before_[rows[k]][c]) / kStepS;
        before_[rows[k]][c] = now;
      }
  }
  void measure(const Rows& rows, const Table<double>& out) const override {
    for (int k = 0; k < rows.count; ++k)
      for (int c = 0; c < 2; ++c) out[rows[k]][c] = velocity_[rows[k]][c];
  }

 private:
  Table<double> position_, before_, velocity_;
};

// Coordinate of the torso, at the start of the episode, and how much it changed in the latest step.
class Displacement : public Operation {
 public:
  explicit Displacement(const Arguments& a)
      : position_(a.real("position", 3)), now_(a.real("now", 1)), start_(a.real("start", 1)), change_(a.real("change", 1)),
        axis_(static_cast<int>(a.number("axis"))) {
    if (axis_ < 0 || axis_ > 2) throw std::invalid_argument("operation displacement: axis out of range");
  }
  void begin(const Rows& rows) override {
    for (int k = 0; k < rows.count; ++k) *now_[rows[k]] = *start_[rows[k]] = position_[rows[k]][axis_];
  }
  void update(const Rows& rows) override {
    for (int k = 0; k < rows.count; ++k) {
      const double value = position_[rows[k]][axis_];
      *change_[rows[k]] = value - *now_[rows[k]];
      *now_[rows[k]] = value;
    }
  }

 private:
  Table<double> position_, now_, start_, change_;
  int axis_;
};

// Distance from a line parallel to the x axis, and how much it changed in the latest step.
class Deviation : public Operation {
 public:
  explicit Deviation(const Arguments& a)
      : position_(a.real("position", 3)), now_(a.real("now", 1)), change_(a.real("change", 1)), y_(a.number("y")) {}
  void begin(const Rows& rows) override {
    for (int k = 0; k < rows.count; ++k) *now_[rows[k]] = std::fabs(position_[rows[k]][1] - y_);
  }
  void update(const Rows& rows) override {
    for (int k = 0; k < rows.count; ++k) {
      const double value = std::fabs(position_[rows[k]][1] - y_);
      *change_[rows[k]] = value - *now_[rows[k]];
      *now_[rows[k]] = value;
    }
  }

 private:
  Table<double> position_, now_, change_;
  double y_;
};

// Whether the torso is below a height.
class Below : public Operation {
 public:
  explicit Below(const Arguments& a) : position_(a.real("position", 3)), flag_(a.flag("flag", 1)), height_(a.number("height")) {}
  void begin(const Rows& rows) override {
    for (int k = 0; k < rows.count; ++k) *flag_[rows[k]] = false;
  }
  void update(const Rows& rows) override {
    for (int k = 0; k < rows.count; ++k) *flag_[rows[k]] = position_[rows[k]][2] < height_;
  }

 private:
  Table<double> position_;
  Table<bool> flag_;
  double height_;
};

// Whether a number exceeds a limit, unless another flag is set.
class Beyond : public Operation {
 public:
  explicit Beyond(const Arguments& a)
      : value_(a.real("value", 1)), unless_(a.flag("unless", 1)), flag_(a.flag("flag", 1)), limit_(a.number("limit")) {}
  void begin(const Rows& rows) override {
    for (int k = 0; k < rows.count; ++k) *flag_[rows[k]] = false;
  }
  void update(const Rows& rows) override {
    for (int k = 0; k < rows.count; ++k) *flag_[rows[k]] = *value_[rows[k]] > limit_ && !*unless_[rows[k]];
  }

 private:
  Table<double> value_;
  Table<bool> unless_, flag_;
  double limit_;
};

// Mean square of an array's row, or of the difference to another array's.
class MeanSquare : public Operation {
 public:
  explicit MeanSquare(const Arguments& a) : values_(a.real("values", 0)) {
    if (a.reals.count("less") > 0) less_ = a.real("less", values_.width);
  }
  int width() const override { return 1; }
  void measure(const Rows& rows, const Table<double>& out) const override {
    thread_local std::vector<double> squares;
    squares.resize(static_cast<std::size_t>(values_.width));
    for (int k = 0; k < rows.count; ++k) {
      for (int c = 0; c < values_.width; ++c) {
        const double value = less_.data == nullptr ? values_[rows[k]][c] : values_[rows[k]][c] - less_[rows[k]][c];
        squares[c] = value * value;
      }
      *out[rows[k]] = pairwise_sum(squares.data(), values_.width) / values_.width;
    }
  }

 private:
  Table<double> values_, less_;
};

// How alike left and right joints move, 0 if no more than opposite.
class Alike : public Operation {
 public:
  explicit Alike(const Arguments& a) : speeds_(a.real("speeds", 0)), floor_(a.number("floor")) {
    const auto &left = a.list("left"), &right = a.list("right"), &product = a.list("product"), &square = a.list("square");
    if (right.size() != left.size() || product.size() != left.size() || square.size() != left.size())
      throw std::invalid_argument("operation alike: left, right, product and square differ in length");
    for (std::size_t c = 0; c < left.size(); ++c) {
      for (const double index : {left[c], right[c]})
        if (!(index >= 0 && index < speeds_.width)) throw std::invalid_argument("operation alike: index out of range");
      pairs_.push_back({static_cast<int>(left[c]), static_cast<int>(right[c]), product[c], square[c]});
    }
  }
  int width() const override { return 1; }
  void measure(const Rows& rows, const Table<double>& out) const override {
    thread_local std::vector<double> products, squares;
    const auto count = static_cast<std::int64_t>(pairs_.size());
    products.resize(pairs_.size());
    squares.resize(pairs_.size());
    for (int k = 0; k < rows.count; ++k) {
      const double* speeds = speeds_[rows[k]];
      for (std::size_t c = 0; c < pairs_.size(); ++c) {
        const double left = speeds[pairs_[c].left], right = speeds[pairs_[c].right];
        products[c] = left * right * pairs_[c].product;
        squares[c] = (left * left + right * right) * pairs_[c].square;
      }
      const double alike = pairwise_sum(products.data(), count) / (pairwise_sum(squares.data(), count) + floor_);
      *out[rows[k]] = alike > 0.0 ? alike : 0.0;
    }
  }

 private:
  struct Pair {
    int left, right;
    double product, square;
  };
  Table<double> speeds_;
  double floor_;
  std::vector<Pair> pairs_;
};

template <class Made>
std::unique_ptr<Operation> make(const Arguments& arguments) {
  return std::make_unique<Made>(arguments);
}

const std::map<std::string, std::unique_ptr<Operation> (*)(const Arguments&)> kOperations = {
    {"columns", make<Columns>},
    {"counts", make<Counts>},
    {"flags", make<Flags>},
    {"yaw", make<Yaw>},
    {"heading", make<Heading>},
    {"centre_of_mass", make<CentreOfMass>},
    {"foot_counters", make<FootCounters>},
    {"gravity", make<Gravity>},
    {"velocity", make<Velocity>},
    {"ground_velocity", make<GroundVelocity>},
    {"displacement", make<Displacement>},
    {"deviation", make<Deviation>},
    {"below", make<Below>},
    {"beyond", make<Beyond>},
    {"mean_square", make<MeanSquare>},
    {"alike", make<Alike>},
};

}  // namespace

std::unique_ptr<Operation> make_operation(const Arguments& arguments) {
  const auto at = kOperations.find(arguments.operation);
  if (at == kOperations.end()) throw std::invalid_argument("operation " + arguments.operation + ": there is none of this name");
  return at->second(arguments);
}

}  // namespace naosprint
