// Reading and writing the text that simulation servers and their clients exchange: S-expressions behind a length of four bytes.
#pragma once
#include <string>
#include <string_view>

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

}  // namespace naosim::protocol
