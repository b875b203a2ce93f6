#include "text.hpp"

#include <charconv>
#include <cmath>
#include <cstdio>
#include <cstring>

namespace naosim::protocol {

namespace {
bool blank(char c) { return c == ' ' || c == '\t' || c == '\n' || c == '\r' || c == '\0'; }
bool bracket(char c) { return c == '(' || c == ')'; }
}  // namespace

void Cursor::skip_blanks() {
  while (at_ != end_ && blank(*at_)) ++at_;
}

bool Cursor::done() {
  skip_blanks();
  return at_ == end_;
}

bool Cursor::at_list() {
  skip_blanks();
  return at_ != end_ && *at_ == '(';
}

bool Cursor::enter() {
  if (!at_list()) return false;
  ++at_;
  return true;
}

bool Cursor::enter(std::string_view& tag) {
  if (!enter()) return false;
  if (!atom(tag)) tag = {};
  return true;
}

bool Cursor::atom(std::string_view& word) {
  skip_blanks();
  const char* first = at_;
  while (at_ != end_ && !blank(*at_) && !bracket(*at_)) ++at_;
  word = {first, static_cast<std::size_t>(at_ - first)};
  return at_ != first;
}

bool parse_number(std::string_view word, double& value) {
  if (!word.empty() && word.front() == '+') word.remove_prefix(1);
  const auto [end, error] = std::from_chars(word.data(), word.data() + word.size(), value);
  return error == std::errc{} && end == word.data() + word.size() && !word.empty();
}

bool Cursor::number(double& value) {
  std::string_view word;
  return atom(word) && parse_number(word, value);
}

bool Cursor::numbers(double* values, int count) {
  for (int k = 0; k < count; ++k)
    if (!number(values[k])) return false;
  return true;
}

bool Cursor::leave() {
  for (int depth = 1; at_ != end_; ++at_) {
    if (*at_ == '(') ++depth;
    if (*at_ == ')' && --depth == 0) {
      ++at_;
      return true;
    }
  }
  return false;
}

void append_fixed(std::string& out, double value, int digits) {
  if (!std::isfinite(value)) {
    out += std::isnan(value) ? "nan" : value > 0 ? "inf" : "-inf";
    return;
  }
  char text[352];
  const auto end = std::to_chars(text, text + sizeof text, value, std::chars_format::fixed, digits).ptr;
  out.append(text, end);
}

void append_general(std::string& out, double value) {
  if (value == 0.0) {
    out += std::signbit(value) ? "-0" : "0";
    return;
  }
  char text[32];
  const auto end = std::to_chars(text, text + sizeof text, value, std::chars_format::general, 6).ptr;
  out.append(text, end);
}

void append_size(std::string& out, std::size_t at) {
  const std::uint32_t size = static_cast<std::uint32_t>(out.size() - at - 4);
  for (int k = 0; k < 4; ++k) out[at + k] = static_cast<char>(size >> (24 - 8 * k) & 0xff);
}

}  // namespace naosim::protocol
