//! From the text of a condition to an [`Expression`].
//!
//! By recursive descent; nesting is bounded, so that no text can exhaust the stack.

use std::ops::Range;

use super::expression::{Comparison, Expression, Operand};
use crate::process_image::TagIndex;

/// Parentheses and `not`s within each other.
const DEEPEST: usize = 32;

/// What is wrong with the text of a condition.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct ExpressionError {
    /// Bytes of the text that it is about.
    pub span: Range<usize>,
    /// What is wrong.
    pub message: String,
    /// How to mend it.
    pub hint: String,
}

/// Reads a condition. `resolve` is asked for each name, with its place in the text; a name may hold the placeholder `{}`,
/// which is for `resolve` to fill in.
pub fn parse(
    text: &str,
    resolve: &mut dyn FnMut(&str, Range<usize>) -> TagIndex,
) -> Result<Expression, ExpressionError> {
    let tokens = tokens(text)?;
    let mut parser = Parser { text, tokens: &tokens, at: 0, depth: 0, resolve };
    let expression = parser.or()?;
    match parser.peek() {
        None => Ok(expression),
        Some(Token { kind: Kind::Close, span }) => {
            Err(error(span, "this `)` closes nothing", "remove it, or open one with `(` before"))
        }
        Some(Token { kind: Kind::Comparison(_), span }) => Err(error(
            span,
            "only one comparison can stand here",
            "join two comparisons with `and`: `a < b and b < c`; a condition in parentheses cannot be compared",
        )),
        Some(Token { span, .. }) => {
            Err(error(span, "something is missing before this", "join two conditions with `and` or `or`"))
        }
    }
}

#[derive(Clone, Debug, PartialEq)]
struct Token {
    kind: Kind,
    span: Range<usize>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Name,
    Number(f64),
    And,
    Or,
    Not,
    Comparison(Comparison),
    Open,
    Close,
}

fn error(span: &Range<usize>, message: impl Into<String>, hint: impl Into<String>) -> ExpressionError {
    ExpressionError { span: span.clone(), message: message.into(), hint: hint.into() }
}

fn is_name(letter: char) -> bool {
    letter.is_alphanumeric() || matches!(letter, '_' | '{' | '}')
}

fn tokens(text: &str) -> Result<Vec<Token>, ExpressionError> {
    let mut tokens = Vec::new();
    let mut rest = text;
    loop {
        rest = rest.trim_start();
        let start = text.len() - rest.len();
        let Some(first) = rest.chars().next() else { return Ok(tokens) };
        let (kind, length) = if first.is_ascii_digit() || matches!(first, '-' | '+' | '.') {
            number(rest, start)?
        } else if is_name(first) {
            word(rest)
        } else {
            sign(rest, start)?
        };
        tokens.push(Token { kind, span: start..start + length });
        rest = rest.get(length..).unwrap_or_default();
    }
}

fn number(rest: &str, start: usize) -> Result<(Kind, usize), ExpressionError> {
    let mut length = 0;
    let mut previous = ' ';
    for letter in rest.chars() {
        let sign = matches!(letter, '-' | '+') && (length == 0 || matches!(previous, 'e' | 'E'));
        if !(letter.is_ascii_alphanumeric() || letter == '.' || letter == '_' || sign) {
            break;
        }
        length += letter.len_utf8();
        previous = letter;
    }
    let text = rest.get(..length).unwrap_or_default();
    let value = match text.strip_prefix("0x") {
        Some(hexadecimal) => u32::from_str_radix(hexadecimal, 16).ok().map(f64::from),
        None => text.parse::<f64>().ok().filter(|number| number.is_finite()),
    };
    match value {
        Some(value) => Ok((Kind::Number(value), length)),
        None => Err(error(
            &(start..start + length.max(1)),
            format!("`{text}` is not a number"),
            "write numbers as 12, -0.5 or 0x1F; conditions have no arithmetic, make a derived tag for that",
        )),
    }
}

fn word(rest: &str) -> (Kind, usize) {
    let length = rest.find(|letter| !is_name(letter)).unwrap_or(rest.len());
    let kind = match rest.get(..length) {
        Some("and") => Kind::And,
        Some("or") => Kind::Or,
        Some("not") => Kind::Not,
        _ => Kind::Name,
    };
    (kind, length)
}

fn sign(rest: &str, start: usize) -> Result<(Kind, usize), ExpressionError> {
    let signs = [
        ("<=", Kind::Comparison(Comparison::LessOrEqual)),
        (">=", Kind::Comparison(Comparison::GreaterOrEqual)),
        ("==", Kind::Comparison(Comparison::Equal)),
        ("!=", Kind::Comparison(Comparison::NotEqual)),
        ("<", Kind::Comparison(Comparison::Less)),
        (">", Kind::Comparison(Comparison::Greater)),
        ("(", Kind::Open),
        (")", Kind::Close),
    ];
    if let Some((sign, kind)) = signs.into_iter().find(|(sign, _)| rest.starts_with(sign)) {
        return Ok((kind, sign.len()));
    }
    let letter = rest.chars().next().unwrap_or(' ');
    let hint = match letter {
        '=' => "equality is written `==`",
        '&' => "write `and`",
        '|' => "write `or`",
        '!' => "write `not`",
        '*' | '/' => "conditions have no arithmetic: make a derived tag for that",
        _ => {
            "a condition is made of tag names, numbers, `and`, `or`, `not`, `<`, `<=`, `>`, `>=`, `==`, `!=` and parentheses"
        }
    };
    Err(error(&(start..start + letter.len_utf8()), format!("`{letter}` cannot stand in a condition"), hint))
}

struct Parser<'a> {
    text: &'a str,
    tokens: &'a [Token],
    at: usize,
    depth: usize,
    resolve: &'a mut dyn FnMut(&str, Range<usize>) -> TagIndex,
}

impl<'a> Parser<'a> {
    fn peek(&self) -> Option<&'a Token> {
        self.tokens.get(self.at)
    }

    fn take(&mut self, kind: Kind) -> bool {
        let found = self.peek().is_some_and(|token| token.kind == kind);
        self.at += usize::from(found);
        found
    }

    fn end(&self) -> Range<usize> {
        self.text.len()..self.text.len()
    }

    fn or(&mut self) -> Result<Expression, ExpressionError> {
        let mut parts = vec![self.and()?];
        while self.take(Kind::Or) {
            parts.push(self.and()?);
        }
        Ok(single_or(parts, Expression::Or))
    }

    fn and(&mut self) -> Result<Expression, ExpressionError> {
        let mut parts = vec![self.not()?];
        while self.take(Kind::And) {
            parts.push(self.not()?);
        }
        Ok(single_or(parts, Expression::And))
    }

    fn not(&mut self) -> Result<Expression, ExpressionError> {
        if !self.take(Kind::Not) {
            return self.primary();
        }
        self.nested(Self::not).map(|part| Expression::Not(Box::new(part)))
    }

    fn primary(&mut self) -> Result<Expression, ExpressionError> {
        let opened = self.peek().map_or_else(|| self.end(), |token| token.span.clone());
        if self.take(Kind::Open) {
            let inner = self.nested(Self::or)?;
            if self.take(Kind::Close) {
                return Ok(inner);
            }
            return match self.peek() {
                None => Err(error(&opened, "this `(` is not closed", "add a `)`")),
                Some(token) => Err(error(
                    &token.span,
                    "`)`, `and` or `or` must stand here",
                    "close the parenthesis before",
                )),
            };
        }
        let left = self.operand()?;
        if let Some(Token { kind: Kind::Comparison(comparison), .. }) = self.peek() {
            self.at += 1;
            let right = self.operand()?;
            return Ok(Expression::Compare { left, comparison: *comparison, right });
        }
        match left {
            Operand::Tag(tag) => Ok(Expression::Tag(tag)),
            Operand::Number(_) => {
                Err(error(&opened, "a number alone is not a condition", "compare it with a tag: `tag > 5`"))
            }
        }
    }

    fn operand(&mut self) -> Result<Operand, ExpressionError> {
        let Some(token) = self.peek() else {
            let hint = "the text ends where a tag's name or a number should stand";
            return Err(error(&self.end(), "the condition is not complete", hint));
        };
        self.at += 1;
        match token.kind {
            Kind::Number(number) => Ok(Operand::Number(number)),
            Kind::Name => {
                let name = self.text.get(token.span.clone()).unwrap_or_default();
                Ok(Operand::Tag((self.resolve)(name, token.span.clone())))
            }
            Kind::And | Kind::Or | Kind::Not | Kind::Comparison(_) | Kind::Open | Kind::Close => {
                let found = self.text.get(token.span.clone()).unwrap_or_default();
                Err(error(
                    &token.span,
                    format!("a tag's name or a number must stand here, not `{found}`"),
                    "for example `trip or knock_intensity_1 > 50`",
                ))
            }
        }
    }

    fn nested(
        &mut self,
        read: impl FnOnce(&mut Self) -> Result<Expression, ExpressionError>,
    ) -> Result<Expression, ExpressionError> {
        if self.depth == DEEPEST {
            let span = self.peek().map_or_else(|| self.end(), |token| token.span.clone());
            return Err(error(
                &span,
                format!("more than {DEEPEST} conditions within each other"),
                "split it: make derived tags of its parts",
            ));
        }
        self.depth += 1;
        let result = read(self);
        self.depth -= 1;
        result
    }
}

fn single_or(mut parts: Vec<Expression>, join: impl FnOnce(Vec<Expression>) -> Expression) -> Expression {
    match (parts.pop(), parts.is_empty()) {
        (Some(only), true) => only,
        (last, _) => {
            parts.extend(last);
            join(parts)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::process_image::{Quality, Reason, Value};

    fn read(text: &str) -> Result<Expression, ExpressionError> {
        parse(text, &mut |name, _| TagIndex(usize::from(name.as_bytes()[0] - b'a')))
    }

    fn holds(text: &str, values: &[f64]) -> bool {
        read(text).unwrap().evaluate(&|tag| (Value::Float(values[tag.0]), Quality::Good)).0
    }

    #[test]
    fn or_binds_weaker_than_and_and_and_weaker_than_not() {
        assert!(holds("a or b and c", &[1.0, 0.0, 0.0]));
        assert!(!holds("(a or b) and c", &[1.0, 0.0, 0.0]));
        assert!(!holds("not a and b", &[1.0, 1.0]));
        assert!(holds("not (a and b)", &[1.0, 0.0]));
        assert!(holds("not a > 3", &[2.0]));
    }

    #[test]
    fn every_comparison_compares() {
        for (text, expected) in [
            ("a < b", true),
            ("a <= b", true),
            ("a > b", false),
            ("a >= b", false),
            ("a == b", false),
            ("a != b", true),
            ("a>=-1.5e0", true),
            ("0x10 == 16", true),
        ] {
            assert_eq!(holds(text, &[1.0, 2.0]), expected, "{text}");
        }
    }

    #[test]
    fn the_quality_is_the_worst_of_all_tags_whatever_decides() {
        let expression = read("a or b").unwrap();
        let stale = Quality::Stale(Reason::PdoTimeout);
        let (holds, quality) =
            expression.evaluate(&|tag| (Value::Bool(true), if tag.0 == 0 { Quality::Good } else { stale }));
        assert!(holds);
        assert_eq!(quality, stale);
    }

    #[test]
    fn errors_say_where_and_how_to_mend_it() {
        for (text, at, message) in [
            ("", 0, "the condition is not complete"),
            ("a and", 5, "the condition is not complete"),
            ("a = 3", 2, "`=` cannot stand in a condition"),
            ("a < b < c", 6, "only one comparison can stand here"),
            ("(a or b", 0, "this `(` is not closed"),
            ("a)", 1, "this `)` closes nothing"),
            ("5", 0, "a number alone is not a condition"),
            ("a b", 2, "something is missing before this"),
            ("a > 1x", 4, "`1x` is not a number"),
            ("a + 3", 2, "`+` is not a number"),
            ("and a", 0, "a tag's name or a number must stand here, not `and`"),
            ("a § b", 2, "`§` cannot stand in a condition"),
        ] {
            let error = read(text).unwrap_err();
            assert_eq!((error.span.start, error.message.as_str()), (at, message), "{text}");
            assert!(!error.hint.is_empty(), "{text}");
        }
    }

    #[test]
    fn nesting_is_bounded() {
        let deep = |levels: usize| format!("{}a{}", "(".repeat(levels), ")".repeat(levels));
        assert!(read(&deep(DEEPEST)).is_ok());
        assert!(read(&deep(DEEPEST + 1)).unwrap_err().message.contains("within each other"));
        assert!(read(&deep(100_000)).is_err());
        assert!(read(&format!("{}a", "not ".repeat(100_000))).is_err());
    }

    proptest::proptest! {
        #[test]
        fn no_text_makes_the_parser_panic(text in "[a-c0-9 ()<>=!.andort§-]{0,60}") {
            let _result = read(&text);
        }
    }
}
