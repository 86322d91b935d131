//! A parameter's value: between YAML, the wire and the configuration.

use ros2_interfaces_jazzy_serde::rcl_interfaces::msg::ParameterValue;
use serde_yaml_ng::Value as Yaml;

/// One of the types that ROS parameters have, numbered as rcl_interfaces/ParameterType.
#[derive(Clone, Debug, PartialEq)]
#[repr(u8)]
pub enum Value {
    /// None.
    NotSet = 0,
    /// true or false.
    Bool(bool) = 1,
    /// 64 bits.
    Integer(i64) = 2,
    /// 64 bits.
    Double(f64) = 3,
    /// Text.
    String(String) = 4,
    /// Bytes.
    ByteArray(Vec<u8>) = 5,
    /// Booleans.
    BoolArray(Vec<bool>) = 6,
    /// Integers.
    IntegerArray(Vec<i64>) = 7,
    /// Doubles.
    DoubleArray(Vec<f64>) = 8,
    /// Texts.
    StringArray(Vec<String>) = 9,
}

impl Value {
    /// The number of its type.
    pub fn type_number(&self) -> u8 {
        match self {
            Self::NotSet => 0,
            Self::Bool(_) => 1,
            Self::Integer(_) => 2,
            Self::Double(_) => 3,
            Self::String(_) => 4,
            Self::ByteArray(_) => 5,
            Self::BoolArray(_) => 6,
            Self::IntegerArray(_) => 7,
            Self::DoubleArray(_) => 8,
            Self::StringArray(_) => 9,
        }
    }

    /// The name of its type.
    pub fn type_name(&self) -> &'static str {
        const NAMES: [&str; 10] = [
            "not set",
            "bool",
            "integer",
            "double",
            "string",
            "byte array",
            "bool array",
            "integer array",
            "double array",
            "string array",
        ];
        NAMES[usize::from(self.type_number())]
    }

    /// From YAML, as parameter files have it; `None` for mappings and lists of more than one type.
    pub fn from_yaml(yaml: &Yaml) -> Option<Self> {
        Some(match yaml {
            Yaml::Null => Self::NotSet,
            Yaml::Bool(value) => Self::Bool(*value),
            Yaml::Number(number) => {
                number.as_i64().map_or_else(|| number.as_f64().map(Self::Double), |i| Some(Self::Integer(i)))?
            }
            Yaml::String(text) => Self::String(text.clone()),
            Yaml::Sequence(items) => {
                let items: Vec<Self> = items.iter().map(Self::from_yaml).collect::<Option<_>>()?;
                Self::array(&items)?
            }
            Yaml::Mapping(_) | Yaml::Tagged(_) => return None,
        })
    }

    /// An array of values of one type; integers among doubles are doubles. Nothing: of strings.
    fn array(items: &[Self]) -> Option<Self> {
        let all = |of: fn(&Self) -> bool| items.iter().all(of);
        Some(match items.first() {
            None => Self::StringArray(Vec::new()),
            Some(Self::Bool(_)) => Self::BoolArray(items.iter().map(Self::as_bool).collect::<Option<_>>()?),
            Some(Self::String(_)) => Self::StringArray(items.iter().map(Self::as_text).collect::<Option<_>>()?),
            Some(Self::Integer(_)) if all(|item| matches!(item, Self::Integer(_))) => {
                Self::IntegerArray(items.iter().map(Self::as_integer).collect::<Option<_>>()?)
            }
            Some(_) => Self::DoubleArray(items.iter().map(Self::as_double).collect::<Option<_>>()?),
        })
    }

    /// The same value in the type of another: integers may stand for doubles, an empty list for one of
    /// any type. `None` if it is of another type.
    pub fn in_type_of(&self, other: &Self) -> Option<Self> {
        Some(match (other, self) {
            (Self::Double(_), Self::Integer(i)) => Self::Double(*i as f64),
            (Self::DoubleArray(_), Self::IntegerArray(items)) => {
                Self::DoubleArray(items.iter().map(|i| *i as f64).collect())
            }
            (Self::BoolArray(_), Self::StringArray(items)) if items.is_empty() => Self::BoolArray(Vec::new()),
            (Self::IntegerArray(_), Self::StringArray(items)) if items.is_empty() => Self::IntegerArray(Vec::new()),
            (Self::DoubleArray(_), Self::StringArray(items)) if items.is_empty() => Self::DoubleArray(Vec::new()),
            _ if self.type_number() == other.type_number() => self.clone(),
            _ => return None,
        })
    }

    /// As YAML.
    pub fn to_yaml(&self) -> Yaml {
        fn list<T: Clone + Into<Yaml>>(items: &[T]) -> Yaml {
            Yaml::Sequence(items.iter().cloned().map(Into::into).collect())
        }
        match self {
            Self::NotSet => Yaml::Null,
            Self::Bool(value) => (*value).into(),
            Self::Integer(value) => (*value).into(),
            Self::Double(value) => (*value).into(),
            Self::String(value) => value.clone().into(),
            Self::ByteArray(items) => list(items),
            Self::BoolArray(items) => list(items),
            Self::IntegerArray(items) => list(items),
            Self::DoubleArray(items) => list(items),
            Self::StringArray(items) => list(items),
        }
    }

    /// If it is one.
    pub fn as_bool(&self) -> Option<bool> {
        if let Self::Bool(value) = self { Some(*value) } else { None }
    }

    /// If it is one.
    pub fn as_integer(&self) -> Option<i64> {
        if let Self::Integer(value) = self { Some(*value) } else { None }
    }

    /// If it is a number.
    pub fn as_double(&self) -> Option<f64> {
        match self {
            Self::Double(value) => Some(*value),
            Self::Integer(value) => Some(*value as f64),
            _ => None,
        }
    }

    /// If it is one.
    pub fn as_text(&self) -> Option<String> {
        if let Self::String(value) = self { Some(value.clone()) } else { None }
    }
}

impl From<&ParameterValue> for Value {
    fn from(wire: &ParameterValue) -> Self {
        match wire.type_ {
            1 => Self::Bool(wire.bool_value),
            2 => Self::Integer(wire.integer_value),
            3 => Self::Double(wire.double_value),
            4 => Self::String(wire.string_value.clone()),
            5 => Self::ByteArray(wire.byte_array_value.clone()),
            6 => Self::BoolArray(wire.bool_array_value.clone()),
            7 => Self::IntegerArray(wire.integer_array_value.clone()),
            8 => Self::DoubleArray(wire.double_array_value.clone()),
            9 => Self::StringArray(wire.string_array_value.clone()),
            _ => Self::NotSet,
        }
    }
}

impl From<&Value> for ParameterValue {
    fn from(value: &Value) -> Self {
        let mut wire = Self { type_: value.type_number(), ..Self::default() };
        match value.clone() {
            Value::NotSet => {}
            Value::Bool(value) => wire.bool_value = value,
            Value::Integer(value) => wire.integer_value = value,
            Value::Double(value) => wire.double_value = value,
            Value::String(value) => wire.string_value = value,
            Value::ByteArray(value) => wire.byte_array_value = value,
            Value::BoolArray(value) => wire.bool_array_value = value,
            Value::IntegerArray(value) => wire.integer_array_value = value,
            Value::DoubleArray(value) => wire.double_array_value = value,
            Value::StringArray(value) => wire.string_array_value = value,
        }
        wire
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_survive_yaml_and_the_wire() {
        for text in ["true", "3", "2.5", "abc", "[true, false]", "[1, 2]", "[1, 2.5]", "[a, b]", "[]"] {
            let value = Value::from_yaml(&serde_yaml_ng::from_str(text).unwrap()).unwrap();
            assert_eq!(Value::from(&ParameterValue::from(&value)), value, "{text}");
            assert_eq!(Value::from_yaml(&value.to_yaml()), Some(value), "{text}");
        }
        assert_eq!(Value::from_yaml(&serde_yaml_ng::from_str("[1, a]").unwrap()), None);
    }

    #[test]
    fn integers_may_stand_for_doubles_and_nothing_else_for_another() {
        assert_eq!(Value::Integer(2).in_type_of(&Value::Double(0.0)), Some(Value::Double(2.0)));
        assert_eq!(Value::Double(2.0).in_type_of(&Value::Integer(0)), None);
        assert_eq!(Value::String("1".into()).in_type_of(&Value::Integer(0)), None);
        let empty = Value::StringArray(Vec::new());
        assert_eq!(empty.in_type_of(&Value::IntegerArray(vec![1])), Some(Value::IntegerArray(Vec::new())));
    }
}
