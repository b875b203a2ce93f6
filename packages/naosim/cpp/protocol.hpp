// The text that rcssserver3d, its agents and its monitors exchange: reading, writing, and one round trip with many servers at once.
#pragma once
#include <array>
#include <cstdint>
#include <random>
#include <string>
#include <string_view>
#include <unordered_map>
#include <utility>
#include <vector>

namespace naosim::protocol {

// Walks over S-expressions without building a tree. Every method returns false where the text does not fit.
class Cursor {
 public:
  explicit Cursor(std::string_view text) : at_(text.data()), begin_(text.data()), end_(text.data() + text.size()) {}
  bool done();                         // only blanks are left
  bool enter(std::string_view& tag);   // "(tag": the tag is empty where a list comes first
  bool enter();                        // "("
  bool atom(std::string_view& word);   // the next word, if one comes before a bracket
  bool number(double& value);          // the next word, if it is a number ("nan" and "inf" are)
  bool numbers(double* values, int count);
  bool leave();                        // skip the rest of the present list and its ")"
  bool at_list();
  std::size_t offset() const { return static_cast<std::size_t>(at_ - begin_); }

 private:
  void skip_blanks();
  const char *at_, *begin_, *end_;
};

bool parse_number(std::string_view word, double& value);

// Append numbers as the server prints them.
void append_fixed(std::string& out, double value, int digits);
void append_general(std::string& out, double value);  // six significant digits
void append_size(std::string& out, std::size_t at);   // fill in the length of what follows the four bytes at `at`

// What one agent message carries. Touch sensors: right foot, left foot, right toe, left toe.
struct Percepts {
  double *joint_angles, *gyro, *accel, *touch[4];
  double* time;
  double* game_time;
};

struct GameState {
  std::string play_mode;
  int uniform_number = 0;
  int side = 0;  // 0 unknown, 1 left, 2 right
};

class PerceptReader {
 public:
  explicit PerceptReader(const std::vector<std::string>& joints);
  // Returns an empty string or what is wrong with the message; unknown perceptors are skipped.
  std::string read(std::string_view message, const Percepts& to, GameState& game, int& joints_seen) const;
  std::size_t joint_count() const { return index_.size(); }

 private:
  std::unordered_map<std::string_view, int> index_;
  std::vector<std::string> names_;
};

// Mirrors the scene graph of a monitor port.
class SceneReader {
 public:
  // Returns an empty string or what is wrong with the frame.
  std::string read(std::string_view frame);
  bool complete() const { return complete_; }  // a full frame has come
  // False where the robot wanted is not in the scene; a robot that is alone there is always the one wanted.
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
class PerceptWriter {
 public:
  struct Item {
    char kind;
    std::string name;
    int index;
  };
  PerceptWriter(std::vector<Item> items, int digits) : items_(std::move(items)), digits_(digits) {}
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

// One agent connection and one monitor connection to each of many servers: send to all, then collect from all.
class Exchange {
 public:
  Exchange(int n, std::vector<std::string> joints, std::vector<std::string> effectors);
  ~Exchange();
  Exchange(const Exchange&) = delete;
  Exchange& operator=(const Exchange&) = delete;

  int size() const { return static_cast<int>(channels_.size()); }
  std::size_t joint_count() const { return joints_; }
  void attach(int row, int agent_fd, int monitor_fd);  // takes the sockets over; monitor_fd may be -1
  void detach(int row);
  void choose(int row, int side, int uniform_number);  // whose torso is the truth
  void post(int row, bool monitor, std::string_view payload);
  // Send (n, joints) speeds and "(syn)" to the chosen rows.
  void dispatch(const double* speeds, const std::uint8_t* rows);
  // Wait for the answer of each chosen row to what was dispatched: one message and, with a monitor, one frame.
  // Returns how many rows have failed, all told.
  int gather(const std::uint8_t* rows, double timeout_s);
  // Wait until every chosen row got `messages` agent messages and `frames` monitor frames.
  void collect(const std::uint8_t* rows, int messages, int frames, double timeout_s);
  // Read what is there and go on until nothing came for `quiet_s`; count messages and frames in `messages_of` and `frames_of`.
  void drain(int row, double quiet_s, double timeout_s);
  const std::string& failure(int row) const { return channels_[row].failure; }
  long messages_of(int row) const { return channels_[row].messages; }
  long frames_of(int row) const { return channels_[row].frames; }
  int joints_seen(int row) const { return channels_[row].joints_seen; }
  bool torso_seen(int row) const { return channels_[row].torso_seen; }
  bool scene_complete(int row) const { return channels_[row].scene.complete(); }
  const GameState& game(int row) const { return channels_[row].game; }
  void fail(int row, std::string reason);

  std::vector<double> joint_angles, gyro, accel, touch[4], time, game_time, torso_position, torso_rotation, ball;

 private:
  struct Stream {
    int fd = -1;
    std::string buffer;
    std::size_t used = 0;
  };
  struct Channel {
    Stream agent, monitor;
    PerceptReader reader;
    SceneReader scene;
    GameState game;
    int side = 0, uniform_number = 0, joints_seen = 0;
    bool torso_seen = false;
    long messages = 0, frames = 0;
    long message_goal = 0, frame_goal = 0;  // how many there will be once the server has answered
    std::string failure;
    explicit Channel(const std::vector<std::string>& names) : reader(names) {}
  };
  void send(int row, bool monitor, std::string_view framed);
  void wait(const std::uint8_t* rows, double timeout_s);
  bool receive(int row, bool monitor);  // false once the row has failed
  bool parse(int row, bool monitor);
  std::size_t joints_;
  std::vector<std::string> effectors_;
  std::vector<Channel> channels_;
};

}  // namespace naosim::protocol
