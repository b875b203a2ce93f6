// The text that rcssserver3d, its agents and its monitors exchange.
#pragma once
#include <array>
#include <cstdint>
#include <random>
#include <string>
#include <string_view>
#include <unordered_map>
#include <utility>
#include <vector>

#include "exchange.hpp"
#include "text.hpp"

namespace naosim::protocol {

// Destination of the perceptors in one agent message. Touch sensors: right foot, left foot, right toe, left toe.
struct PerceptorTargets {
  double *joint_angles, *gyro, *accel, *touch[4];
  double* time;
  double* game_time;
  double* vision;  // distance, theta and phi of each landmark
};

struct GameState {
  std::string play_mode;
  int uniform_number = 0;
  int side = 0;  // 0 unknown, 1 left, 2 right
};

class PerceptorReader {
 public:
  PerceptorReader(const std::vector<std::string>& joints, const std::vector<std::string>& landmarks);
  // Returns an empty string or what is wrong with the message; unknown perceptors are skipped.
  std::string read(std::string_view message, const PerceptorTargets& to, GameState& game, int& joints_seen) const;
  std::size_t joint_count() const { return names_.size(); }

 private:
  std::unordered_map<std::string_view, int> index_, landmark_;
  std::vector<std::string> names_, landmarks_;
};

// Mirrors the scene graph of a monitor port.
class SceneReader {
 public:
  // Returns an empty string or what is wrong with the frame.
  std::string read(std::string_view frame);
  bool complete() const { return complete_; }  // a full frame has been received
  // False if the requested robot is not in the scene; the only robot of a scene always counts as the requested one.
  bool torso(int side, int uniform_number, double position[3], double rotation[9]) const;
  bool ball(double position[3]) const;
  int robots() const { return static_cast<int>(robots_.size()); }
  double time() const { return time_; }
  int play_mode() const { return play_mode_; }

 private:
  struct Node {
    int parent;
    bool transform;
    std::array<double, 16> pose;  // column-major, relative to the parent
    bool wanted;                  // a torso, the ball, or above one: incremental poses of the others are not read
  };
  struct Robot {
    int node, side, uniform_number;
  };
  std::string read_nodes(Cursor& cursor, bool full);
  void want(int node);
  void world(int node, double position[3], double rotation[9]) const;
  std::vector<Node> nodes_;
  std::vector<Robot> robots_;
  int ball_ = -1;
  double time_ = 0.0;
  int play_mode_ = -1;
  bool complete_ = false;
};

// Writes the scene graph; `steps` is the graph in the order of printing.
class SceneWriter {
 public:
  static constexpr int kClose = -2, kStill = -1;
  struct Step {
    std::string full, incremental;
    int body;  // a row of the poses, kStill for text alone, kClose for the end of a node
  };
  SceneWriter(std::vector<Step> steps, int bodies);
  int bodies() const { return static_cast<int>(sent_.size()); }
  // poses: (bodies, 13) as the engine has them. An incremental frame holds what moved by more than 0.005 since it was last sent.
  std::string write(std::string_view head, bool full, const double* poses);

 private:
  std::vector<Step> steps_;
  std::vector<std::array<float, 16>> sent_;
};

// Writes agent messages. Items: kind 'j' joint, 't' touch sensor, 's' the place of See.
class PerceptorWriter {
 public:
  struct Item {
    char kind;
    std::string name;
    int index;
  };
  PerceptorWriter(std::vector<Item> items, int digits) : items_(std::move(items)), digits_(digits) {}
  std::string write(std::string_view head, std::string_view see, const double* gyro, const double* accel, const double* angles,
                    const double* const touch[4]) const;

 private:
  std::vector<Item> items_;
  int digits_;
};

// The restricted vision perceptor with the noise of the real one.
class Vision {
 public:
  struct Landmark {
    std::string name;
    double position[3];
  };
  using Line = std::array<double, 6>;
  Vision(std::vector<Landmark> landmarks, std::vector<Line> lines, int digits, std::uint64_t seed, bool noise);
  // Position and rotation (row-major) of the head; body parts are printed inside one P of the own team.
  std::string see(const double position[3], const double rotation[9], const std::vector<Landmark>& moving, std::string_view self,
                  const std::vector<Landmark>& parts);

 private:
  struct Polar {
    double distance, theta, phi;
  };
  void local(const double world[3], double out[3]) const;
  bool visible(const double relative[3], Polar& out) const;
  void blur(Polar& seen);
  void append(std::string& out, const Polar& seen) const;
  void append_landmark(std::string& out, const Landmark& landmark);
  std::vector<Landmark> landmarks_;
  std::vector<Line> lines_;
  int digits_;
  bool noise_;
  std::mt19937_64 random_;
  std::normal_distribution<double> normal_;
  double error_[3] = {0, 0, 0};
  double position_[3] = {}, rotation_[9] = {};
};

// The exchange with rcssserver3d: an agent port each, and a monitor port that gives the ground truth.
class SparkExchange final : public Exchange {
 public:
  SparkExchange(int n, std::vector<std::string> joints, std::vector<std::string> effectors, std::vector<std::string> landmarks);
  std::size_t joint_count() const { return joints_; }
  void choose(int row, int side, int uniform_number);  // robot whose torso pose is reported
  int joints_seen(int row) const { return robots_[row].joints_seen; }
  bool torso_seen(int row) const { return robots_[row].torso_seen; }
  bool scene_complete(int row) const { return robots_[row].scene.complete(); }
  const GameState& game(int row) const { return robots_[row].game; }

  std::vector<double> joint_angles, gyro, accel, touch[4], time, game_time, torso_position, torso_rotation, ball, vision;

 private:
  struct Robot {
    SceneReader scene;
    GameState game;
    int side = 0, uniform_number = 0, joints_seen = 0;
    bool torso_seen = false;
  };
  void clear(int row) override;
  void compose(int row, const double* speeds, std::string& message) override;  // (joints,) rad/s
  void compose_idle(int row, std::string& message) override { compose(row, std::vector<double>(joints_).data(), message); }
  std::string read(int row, bool monitor, std::string_view text) override;
  std::string lacking(int row) const override;
  std::size_t joints_, sights_;
  std::vector<std::string> openings_;  // "(he1 "
  PerceptorReader reader_;
  std::vector<Robot> robots_;
};

}  // namespace naosim::protocol
