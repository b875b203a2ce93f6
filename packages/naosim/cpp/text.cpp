#include "text.hpp"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>

namespace naosim::protocol {

namespace {

constexpr int kExactDigits = 15;  // integers and powers of ten of up to so many digits are exact, so their quotient is rounded once
constexpr std::array<double, kExactDigits + 1> kPowers = {1e0, 1e1, 1e2,  1e3,  1e4,  1e5,  1e6,  1e7,
                                                          1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15};

// Reads what servers print nearly always: a sign, digits, and perhaps a point among them.
bool parse_short(std::string_view word, double& value) {
  const bool negative = !word.empty() && word.front() == '-';
  if (negative) word.remove_prefix(1);
  if (word.empty() || word.size() > kExactDigits + 1) return false;
  std::int64_t digits = 0;
  std::size_t point = word.size();
  for (std::size_t k = 0; k < word.size(); ++k) {
    const unsigned digit = static_cast<unsigned char>(word[k]) - unsigned{'0'};
    if (digit < 10) {
      digits = 10 * digits + digit;
    } else if (word[k] == '.' && point == word.size()) {
      point = k;
    } else {
      return false;
    }
  }
  const bool pointed = point < word.size();
  if (word.size() - pointed == 0 || word.size() - pointed > kExactDigits) return false;
  const double magnitude = static_cast<double>(digits) / kPowers[pointed ? word.size() - point - 1 : 0];
  value = negative ? -magnitude : magnitude;
  return true;
}

}  // namespace

bool finite(const double* values, std::size_t count) {
  return std::all_of(values, values + count, [](double value) { return std::isfinite(value); });
}

bool parse_number(std::string_view word, double& value) {
  if (!word.empty() && word.front() == '+') word.remove_prefix(1);
  if (parse_short(word, value)) return true;
  const auto [end, error] = std::from_chars(word.data(), word.data() + word.size(), value);
  return error == std::errc{} && end == word.data() + word.size() && !word.empty();
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
