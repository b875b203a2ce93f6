// One round trip with many servers at once: send to all, then collect from all. Subclasses define the messages.
#pragma once
#include <atomic>
#include <chrono>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

namespace naosim::protocol {

// What is wrong with a robot of a world that has diverged.
constexpr char kNotFinite[] = "a perceptor or the torso's pose is not a finite number";

// One agent connection, and possibly one monitor connection, to each of many servers.
class Exchange {
 public:
  explicit Exchange(int n);
  virtual ~Exchange();
  Exchange(const Exchange&) = delete;
  Exchange& operator=(const Exchange&) = delete;

  int size() const { return static_cast<int>(channels_.size()); }
  void attach(int row, int agent_fd, int monitor_fd);  // takes the sockets over; monitor_fd may be -1
  void detach(int row);
  void post(int row, bool monitor, std::string_view payload);
  // Send (n, width) commands to the chosen rows.
  void dispatch(const double* commands, std::size_t width, const std::uint8_t* rows);
  // Wait for the answer of each chosen row to what was dispatched: one message and, with a monitor, one frame.
  // With `keeping`, admitted rows are renewed meanwhile.
  // Returns how many rows have failed in total.
  int gather(const std::uint8_t* rows, double timeout_s, bool keeping);
  // Keep the row's robot from now on: its server is among those that `renew` steps, and fails once it sends more messages than
  // it got commands. Until then, and once it is detached, another thread may work on the row.
  void admit(int row) { channels_[row].admitted = true; }
  // Servers are stepped after this silence of ours. One that drops its robot after more than twice as much is not to blame.
  void set_silence(double silence_s) { silence_s_ = silence_s; }
  // Read what admitted servers have sent, and step those to which nothing was sent for a while, so that they keep their robots.
  // Waits for nothing. Returns how many rows have failed in total.
  int renew();
  // Wait until every chosen row got `messages` agent messages and `frames` monitor frames.
  void collect(const std::uint8_t* rows, int messages, int frames, double timeout_s);
  // Read until nothing has arrived for `quiet_s`.
  void drain(int row, double quiet_s, double timeout_s);
  const std::string& failure(int row) const { return channels_[row].failure; }
  // Whether the server dropped its robot because we were silent.
  bool neglected(int row) const { return channels_[row].neglected; }
  long messages_of(int row) const { return channels_[row].messages; }
  long frames_of(int row) const { return channels_[row].frames; }
  void fail(int row, std::string reason);

 protected:
  // Forget what the row's last server has sent.
  virtual void clear(int row) = 0;
  // Append the message that carries a command.
  virtual void compose(int row, const double* command, std::string& message) = 0;
  // Append a message that runs a cycle in which the robot keeps still, or holds its targets.
  virtual void compose_idle(int row, std::string& message) = 0;
  // Returns an empty string or what is wrong with a message of the agent port or a frame of the monitor port.
  virtual std::string read(int row, bool monitor, std::string_view text) = 0;
  // Returns an empty string or what is missing from an answer.
  virtual std::string lacking(int row) const = 0;

 private:
  struct Stream {
    int fd = -1;
    std::string buffer;
    std::size_t used = 0;
    bool acknowledges = false;  // at once, since the server waits for it
  };
  struct Channel {
    Stream agent, monitor;
    long messages = 0, frames = 0;
    long message_goal = 0, frame_goal = 0;  // how many there will be once the server has answered
    std::chrono::steady_clock::time_point spoken{};  // when something was last sent to the agent port
    double silence_s = 0;                            // how long the server had waited for that
    bool neglected = false;
    std::string failure;
    std::atomic<bool> admitted{false};
    std::atomic<bool> failed{true};  // whether there is a failure, for other threads
  };
  bool answered(const Channel& c) const { return c.messages >= c.message_goal; }
  int failed() const;
  void expect(Channel& c, int messages, int frames);
  void lose(int row, bool monitor, const char* why);
  void send(int row, bool monitor, std::string_view framed);
  void wait(const std::uint8_t* rows, double timeout_s, bool keeping);
  // Read what there is, or wait for it for a moment; false once the row has failed.
  bool receive(int row, bool monitor, bool waiting = false);
  bool parse(int row, bool monitor);
  std::vector<Channel> channels_;
  double silence_s_ = 1e9;
};

}  // namespace naosim::protocol
