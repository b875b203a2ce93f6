// Reading and writing the text that simulation servers and their clients exchange: S-expressions behind a length of four bytes.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>

namespace naosim::protocol {

bool parse_number(std::string_view word, double& value);

// Whether all numbers are finite: what a server reports of a world that has diverged is not.
bool finite(const double* values, std::size_t count);

// Walks over S-expressions without building a tree. Every method returns false where the text does not fit. All is inline:
// a frame has hundreds of short words.
class Cursor {
 public:
  explicit Cursor(std::string_view text) : at_(text.data()), begin_(text.data()), end_(text.data() + text.size()) {}

  bool done() {  // only blanks are left
    skip_blanks();
    return at_ == end_;
  }

  bool at_list() {
    skip_blanks();
    return at_ != end_ && *at_ == '(';
  }

  bool enter() {  // "("
    if (!at_list()) return false;
    ++at_;
    return true;
  }

  bool enter(std::string_view& tag) {  // "(tag": the tag is empty where a list comes first
    if (!enter()) return false;
    if (!atom(tag)) tag = {};
    return true;
  }

  bool atom(std::string_view& word) {  // the next word, if one comes before a bracket
    skip_blanks();
    const char* first = at_;
    while (at_ != end_ && kind(*at_) == kLetter) ++at_;
    word = {first, static_cast<std::size_t>(at_ - first)};
    return at_ != first;
  }

  bool number(double& value) {  // the next word, if it is a number ("nan" and "inf" are)
    std::string_view word;
    return atom(word) && parse_number(word, value);
  }

  bool numbers(double* values, int count) {
    for (int k = 0; k < count; ++k)
      if (!number(values[k])) return false;
    return true;
  }

  bool leave() {  // skip the rest of the present list and its ")"
    for (int depth = 1; at_ != end_; ++at_) {
      if (kind(*at_) != kBracket) continue;
      depth += *at_ == '(' ? 1 : -1;
      if (depth == 0) {
        ++at_;
        return true;
      }
    }
    return false;
  }

  std::size_t offset() const { return static_cast<std::size_t>(at_ - begin_); }

 private:
  enum Kind : std::uint8_t { kLetter, kBlank, kBracket };

  static Kind kind(char c) {
    static constexpr std::array<Kind, 256> kinds = [] {
      std::array<Kind, 256> found{};
      for (const char blank : {' ', '\t', '\n', '\r', '\0'}) found[static_cast<unsigned char>(blank)] = kBlank;
      for (const char bracket : {'(', ')'}) found[static_cast<unsigned char>(bracket)] = kBracket;
      return found;
    }();
    return kinds[static_cast<unsigned char>(c)];
  }

  void skip_blanks() {
    while (at_ != end_ && kind(*at_) == kBlank) ++at_;
  }

  const char *at_, *begin_, *end_;
};

// Append numbers as the server prints them.
void append_fixed(std::string& out, double value, int digits);
void append_general(std::string& out, double value);  // six significant digits
void append_size(std::string& out, std::size_t at);   // fill in the length of what follows the four bytes at `at`

}  // namespace naosim::protocol
