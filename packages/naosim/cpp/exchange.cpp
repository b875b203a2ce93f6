#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cstring>

#include "exchange.hpp"
#include "text.hpp"

namespace naosim::protocol {

namespace {

constexpr std::size_t kLargestMessage = 1u << 20;  // of an agent port
constexpr std::size_t kLargestFrame = 1u << 26;    // of a monitor port

using Clock = std::chrono::steady_clock;

int left_ms(Clock::time_point until) {
  const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(until - Clock::now()).count();
  return left < 0 ? 0 : left > 60000 ? 60000 : static_cast<int>(left) + 1;
}

Clock::time_point after(double seconds) {
  return Clock::now() + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(seconds));
}

// Why a connection is lost; a server that ends before it has read everything resets it.
const char* reason_of(int error) {
  return error == ECONNRESET || error == EPIPE ? "closed by the server" : std::strerror(error);
}

std::string seconds_text(double seconds) {
  std::string out;
  append_fixed(out, seconds, 1);
  return out + " s";
}

// Acknowledge received data at once. The kernel would wait up to 40 ms for an answer that could carry the
// acknowledgement, and rcssserver3d, which leaves Nagle's algorithm on, would hold the next frame back for as long. To
// an agent port every command is such an answer; a monitor port gets none. It costs a call after every read, so it is
// done on connections on which a frame has been late.
void acknowledge(int fd) {
  const int now = 1;
  ::setsockopt(fd, IPPROTO_TCP, TCP_QUICKACK, &now, sizeof now);
}

// Longest wait in one call, so that other servers are renewed meanwhile, and how much longer it may take before this process must
// have been stopped.
constexpr double kSlice = 0.25, kStopped = 1.0;

double seconds_since(Clock::time_point then) { return std::chrono::duration<double>(Clock::now() - then).count(); }

// How long a read waits for one server before all of them are polled.
constexpr timeval kMoment{0, 20000};

constexpr char kDetached[] = "no server is attached";

const char* port_name(bool monitor) { return monitor ? "monitor port" : "agent port"; }

}  // namespace

Exchange::Exchange(int n) : channels_(static_cast<std::size_t>(n)) {
  for (auto& channel : channels_) channel.failure = kDetached;
}

Exchange::~Exchange() {
  for (int row = 0; row < size(); ++row) detach(row);
}

void Exchange::attach(int row, int agent_fd, int monitor_fd) {
  detach(row);
  Channel& c = channels_[row];
  c.agent.fd = agent_fd;
  c.monitor.fd = monitor_fd;
  for (Stream* stream : {&c.agent, &c.monitor}) {
    stream->buffer.clear();
    stream->used = 0;
    stream->acknowledges = false;
  }
  c.messages = c.frames = c.message_goal = c.frame_goal = 0;
  for (const int fd : {agent_fd, monitor_fd}) {
    if (fd < 0) continue;
    ::setsockopt(fd, SOL_SOCKET, SO_RCVTIMEO, &kMoment, sizeof kMoment);
    ::fcntl(fd, F_SETFL, ::fcntl(fd, F_GETFL) & ~O_NONBLOCK);
  }
  c.spoken = Clock::now();
  c.silence_s = 0;
  c.neglected = false;
  c.failure.clear();
  c.failed = false;
  clear(row);
}

void Exchange::detach(int row) {
  Channel& c = channels_[row];
  c.admitted = false;
  for (Stream* stream : {&c.agent, &c.monitor}) {
    if (stream->fd >= 0) ::close(stream->fd);
    stream->fd = -1;
  }
  if (c.failure.empty()) c.failure = kDetached;
  c.failed = true;
}

void Exchange::fail(int row, std::string reason) {
  Channel& c = channels_[row];
  if (c.failure.empty() || c.failure == kDetached) c.failure = std::move(reason);
  c.failed = true;
}

void Exchange::lose(int row, bool monitor, const char* why) {
  Channel& c = channels_[row];
  if (!c.failure.empty()) return;
  std::string text = std::string(port_name(monitor)) + ": " + why;
  // once it has answered, the server waits for us
  const double silence_s = std::max(c.silence_s, answered(c) ? seconds_since(c.spoken) : 0.0);
  if (silence_s > 2 * silence_s_) {
    c.neglected = true;
    text += " after this process had sent nothing for " + seconds_text(silence_s);
  }
  fail(row, std::move(text));
}

void Exchange::expect(Channel& c, int messages, int frames) {
  // Answers to what was sent before come first.
  c.message_goal = std::max(c.message_goal, c.messages) + messages;
  c.frame_goal = std::max(c.frame_goal, c.frames) + frames;
}

void Exchange::send(int row, bool monitor, std::string_view framed) {
  Channel& c = channels_[row];
  const int fd = monitor ? c.monitor.fd : c.agent.fd;
  if (fd < 0 || !c.failure.empty()) return;
  const auto until = after(5.0);
  if (!monitor) {
    c.silence_s = seconds_since(c.spoken);
    c.spoken = Clock::now();
  }
  while (!framed.empty()) {
    const ssize_t sent = ::send(fd, framed.data(), framed.size(), MSG_NOSIGNAL | MSG_DONTWAIT);
    if (sent > 0) {
      framed.remove_prefix(static_cast<std::size_t>(sent));
    } else if (sent < 0 && errno == EINTR) {
      continue;
    } else if (sent < 0 && (errno == EAGAIN || errno == EWOULDBLOCK)) {
      // The server does not read while it waits for us to read: take what it has sent, then try again.
      if (!receive(row, false) || (c.monitor.fd >= 0 && !receive(row, true))) return;
      pollfd wait{fd, POLLOUT | POLLIN, 0};
      if (::poll(&wait, 1, left_ms(until)) == 0) return fail(row, std::string(port_name(monitor)) + ": the server no longer reads");
    } else {
      return lose(row, monitor, reason_of(errno));
    }
  }
}

void Exchange::post(int row, bool monitor, std::string_view payload) {
  std::string framed(4, '\0');
  framed += payload;
  append_size(framed, 0);
  send(row, monitor, framed);
}

bool Exchange::receive(int row, bool monitor, bool waiting) {
  Channel& c = channels_[row];
  Stream& stream = monitor ? c.monitor : c.agent;
  if (!c.failure.empty() || stream.fd < 0) return false;
  char chunk[65536];
  for (;;) {
    const ssize_t got = ::recv(stream.fd, chunk, sizeof chunk, waiting ? 0 : MSG_DONTWAIT);
    if (got > 0) {
      waiting = false;
      if (stream.acknowledges) acknowledge(stream.fd);
      stream.buffer.append(chunk, static_cast<std::size_t>(got));
      if (!parse(row, monitor)) return false;
      if (static_cast<std::size_t>(got) < sizeof chunk) return true;
    } else if (got == 0) {
      lose(row, monitor, "closed by the server");
      return false;
    } else if (errno == EINTR) {
      continue;
    } else if (errno == EAGAIN || errno == EWOULDBLOCK) {
      if (monitor && waiting) {
        stream.acknowledges = true;
        acknowledge(stream.fd);
      }
      return true;
    } else {
      lose(row, monitor, reason_of(errno));
      return false;
    }
  }
}

bool Exchange::parse(int row, bool monitor) {
  Channel& c = channels_[row];
  Stream& stream = monitor ? c.monitor : c.agent;
  const std::size_t limit = monitor ? kLargestFrame : kLargestMessage;
  for (;;) {
    const std::size_t left = stream.buffer.size() - stream.used;
    if (left < 4) break;
    const auto* b = reinterpret_cast<const unsigned char*>(stream.buffer.data() + stream.used);
    const std::size_t size = static_cast<std::size_t>(b[0]) << 24 | b[1] << 16 | b[2] << 8 | b[3];
    if (size > limit) {
      fail(row, std::string(port_name(monitor)) + ": malformed reply: a message of " + std::to_string(size) + " bytes is announced");
      return false;
    }
    if (left < 4 + size) break;
    const std::string_view text(stream.buffer.data() + stream.used + 4, size);
    const std::string problem = read(row, monitor, text);
    ++(monitor ? c.frames : c.messages);
    stream.used += 4 + size;
    if (!problem.empty()) {
      fail(row, "malformed reply: " + problem);
      return false;
    }
    // at a handshake a server may greet with several messages, and be too slow to be caught running by itself
    if (c.admitted && c.messages > c.message_goal) {
      fail(row, "a message came that answers no command: it must run in sync mode");
      return false;
    }
  }
  if (stream.used == stream.buffer.size()) {
    stream.buffer.clear();
    stream.used = 0;
  } else if (stream.used > 65536) {
    stream.buffer.erase(0, stream.used);
    stream.used = 0;
  }
  return true;
}

void Exchange::dispatch(const double* commands, std::size_t width, const std::uint8_t* rows) {
  std::string message;
  for (int row = 0; row < size(); ++row) {
    if ((rows != nullptr && !rows[row]) || !channels_[row].failure.empty()) continue;
    message.assign(4, '\0');
    compose(row, commands + static_cast<std::size_t>(row) * width, message);
    append_size(message, 0);
    expect(channels_[row], 1, 1);
    send(row, false, message);
  }
}

int Exchange::gather(const std::uint8_t* rows, double timeout_s, bool keeping) {
  wait(rows, timeout_s, keeping);
  for (int row = 0; row < size(); ++row) {
    if ((rows != nullptr && !rows[row]) || !channels_[row].failure.empty()) continue;
    const std::string problem = lacking(row);
    if (!problem.empty()) fail(row, "malformed reply: " + problem);
  }
  return failed();
}

int Exchange::failed() const {
  int count = 0;
  for (const Channel& c : channels_) count += c.failed;
  return count;
}

int Exchange::renew() {
  std::string message;
  for (int row = 0; row < size(); ++row) {
    Channel& c = channels_[row];
    if (!c.admitted || c.failed) continue;
    if (!receive(row, false) || (c.monitor.fd >= 0 && !receive(row, true))) continue;
    if (!answered(c) || seconds_since(c.spoken) < silence_s_) continue;
    message.assign(4, '\0');
    compose_idle(row, message);
    append_size(message, 0);
    expect(c, 1, 1);
    send(row, false, message);
  }
  return failed();
}

void Exchange::collect(const std::uint8_t* rows, int messages, int frames, double timeout_s) {
  for (int row = 0; row < size(); ++row) {
    if (rows != nullptr && !rows[row]) continue;
    expect(channels_[row], messages, frames);
  }
  wait(rows, timeout_s, false);
}

void Exchange::wait(const std::uint8_t* rows, double timeout_s, bool keeping) {
  auto until = after(timeout_s), renewed = Clock::now();
  const auto frame_due = [](const Channel& c) { return c.monitor.fd >= 0 && c.frames < c.frame_goal; };
  const auto due = [&](const Channel& c) { return c.failure.empty() && (c.messages < c.message_goal || frame_due(c)); };
  std::vector<int> waiting;
  for (int row = 0; row < size(); ++row)
    if ((rows == nullptr || rows[row]) && due(channels_[row])) waiting.push_back(row);
  const auto still_waiting = [&] {
    waiting.erase(std::remove_if(waiting.begin(), waiting.end(), [&](int row) { return !due(channels_[row]); }), waiting.end());
  };
  // A server usually answers within a moment. To wait for it in the read saves a call in every cycle.
  for (const int row : waiting) {
    const bool frame = frame_due(channels_[row]);
    if (receive(row, frame, true) && frame) receive(row, false);
  }
  still_waiting();
  std::vector<pollfd> polled;
  std::vector<std::pair<int, bool>> whose;
  while (!waiting.empty()) {
    polled.clear();
    whose.clear();
    for (const int row : waiting) {
      const Channel& c = channels_[row];
      // A wake-up costs more than a read: while a frame is due, data on the agent port can wait, but a closed
      // connection cannot.
      const bool frame = frame_due(c);
      polled.push_back({c.agent.fd, static_cast<short>(frame ? POLLRDHUP : POLLIN), 0});
      whose.emplace_back(row, false);
      if (frame) {
        polled.push_back({c.monitor.fd, POLLIN, 0});
        whose.emplace_back(row, true);
      }
    }
    const auto slice = std::min(until, after(kSlice));
    const int ready = ::poll(polled.data(), polled.size(), left_ms(slice));
    const double late_s = seconds_since(slice);
    if (ready < 0 && errno != EINTR) {
      for (const int row : waiting) fail(row, std::string("poll: ") + std::strerror(errno));
      return;
    }
    if (ready == 0 && late_s <= kStopped && Clock::now() >= until) {
      for (const int row : waiting) {
        const bool agent = channels_[row].messages < channels_[row].message_goal;
        fail(row, std::string(port_name(!agent)) + ": no reply within " + seconds_text(timeout_s));
      }
      return;
    }
    for (std::size_t k = 0; k < polled.size() && ready > 0; ++k)
      if (polled[k].revents != 0 && receive(whose[k].first, whose[k].second) && whose[k].second) receive(whose[k].first, false);
    // The servers may have been stopped with this process.
    if (late_s > kStopped) until += std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(late_s));
    if (keeping && seconds_since(renewed) > kSlice) {
      renew();
      renewed = Clock::now();
    }
    still_waiting();
  }
}

void Exchange::drain(int row, double quiet_s, double timeout_s) {
  Channel& c = channels_[row];
  const auto until = after(timeout_s);
  while (c.failure.empty() && Clock::now() < until) {
    pollfd polled[2] = {{c.agent.fd, POLLIN, 0}, {c.monitor.fd, POLLIN, 0}};
    const int ready = ::poll(polled, c.monitor.fd >= 0 ? 2 : 1, left_ms(after(quiet_s)));
    if (ready == 0) return;
    if (ready < 0 && errno != EINTR) return fail(row, std::string("poll: ") + std::strerror(errno));
    if (polled[0].revents != 0) receive(row, false);
    if (c.monitor.fd >= 0 && polled[1].revents != 0) receive(row, true);
  }
  if (c.failure.empty()) fail(row, "the server does not wait for its agent: it must run in sync mode");
}

}  // namespace naosim::protocol
